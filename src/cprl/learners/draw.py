"""Draw: a batch to learn from that is not gathered yet.

An update gathers its batch itself, so that torch compiles both as one and writes no batch to memory.
"""

from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict
from torch import Tensor


class Draw(NamedTuple):
    """A batch to learn from as the tensors and the function that make it."""

    gather: Any
    """A function of `columns` that makes the batch, [L, b], or sequences [L, .., T]; hashable, because code
    is compiled for each such function."""
    columns: list[Tensor]
    """The tensors from which the batch is gathered."""
    form: Hashable
    """The shapes and dtypes of the columns, for which code is compiled too."""

    @classmethod
    def of(cls, batch: TensorDict, *index: Tensor) -> "Draw":
        """Return the draw of a whole batch that exists, [L, n], or of some of its places.

        Args:
            index: the places of each lane, int64 [L, ...]; none for the whole batch.
        """
        entries = sorted(batch.items(True, True), key=lambda entry: str(entry[0]))
        columns = [*(column for _, column in entries), *index]
        gather = _PackedBatch(tuple(name for name, _ in entries), tuple(batch.batch_size))
        return cls(gather, columns, tuple((column.shape, column.dtype) for column in columns))


class _PackedBatch(NamedTuple):
    """A function that makes a batch of its columns again, or of some of its places, if these are a last
    column."""

    names: tuple[Any, ...]
    """The names of the entries, in the order of their columns."""
    size: tuple[int, ...]
    """The batch size [L, n]."""

    def __call__(self, columns: Sequence[Tensor]) -> TensorDict:
        batch = TensorDict({}, batch_size=self.size)
        for name, column in zip(self.names, columns, strict=False):
            batch.set(name, column)
        if len(columns) == len(self.names):
            return batch
        index = columns[-1]
        lane = torch.arange(len(index), device=index.device).view(-1, *[1] * (index.ndim - 1))
        return batch[lane, index]
