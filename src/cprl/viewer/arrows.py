"""Columns of Rerun made of numpy arrays without its classes, whose conversions take longest."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


def ragged(form: Any, counts: NDArray[np.integer[Any]], values: NDArray[Any]) -> Any:
    """Rows of numbers, lines or bytes, as `cprl.compat.send_chunk` takes them.

    Args:
        form: the `pyarrow` type of the column: lists of numbers, of lists of numbers, or of lists of points.
        counts: how many entries each row has, [T].
        values: the entries of all rows one after the other, in C order: [entries], [entries, length] or
            [entries, length, 2], with the dtype that the type says.
    """
    ends = np.zeros(len(counts) + 1, np.int32)
    np.cumsum(counts, out=ends[1:])
    return _listed(form, ends, _entries(form.value_type, values))


def _entries(form: Any, values: NDArray[Any]) -> Any:
    import pyarrow as pa

    if values.ndim == 1:
        return pa.Array.from_buffers(form, len(values), [None, pa.py_buffer(values)])
    count, length = values.shape[:2]
    if pa.types.is_fixed_size_list(form):
        inner = _entries(form.value_type, values.reshape(-1))
        return pa.Array.from_buffers(form, count, [None], children=[inner])
    ends = np.arange(count + 1, dtype=np.int32) * np.int32(length)
    return _listed(form, ends, _entries(form.value_type, values.reshape(count * length, *values.shape[2:])))


def _listed(form: Any, ends: NDArray[np.int32], entries: Any) -> Any:
    import pyarrow as pa

    return pa.Array.from_buffers(form, len(ends) - 1, [None, pa.py_buffer(ends)], children=[entries])
