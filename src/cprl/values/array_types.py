"""Types of numpy arrays, one for each dtype, and of named tuples of arrays."""

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

AnyArray: TypeAlias = NDArray[Any]
Bool: TypeAlias = NDArray[np.bool_]
UInt8: TypeAlias = NDArray[np.uint8]
UInt32: TypeAlias = NDArray[np.uint32]
"""The type of indices: Numba then skips its check for negative ones."""
UInt64: TypeAlias = NDArray[np.uint64]
Int32: TypeAlias = NDArray[np.int32]
Int64: TypeAlias = NDArray[np.int64]
Float32: TypeAlias = NDArray[np.float32]
Float64: TypeAlias = NDArray[np.float64]


def is_record(kind: Any) -> bool:
    """Return whether a value is a class of named tuples, e.g. `cprl.commons.world.Worlds`."""
    return isinstance(kind, type) and hasattr(kind, "_fields")
