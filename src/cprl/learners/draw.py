"""Draw: a batch to learn from that is not yet gathered."""

from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict
from torch import Tensor


class Draw(NamedTuple):
    """A batch to learn from, which the step itself gathers, so that both are compiled as one."""

    gather: Any
    """A function of the columns that makes the batch, [L, b] or sequences [L, .., T]; hashable, since code is
    compiled for it."""
    columns: list[Tensor]
    form: Hashable
    """The shapes and dtypes of the columns."""

    @classmethod
    def of(cls, batch: TensorDict, *place: Tensor) -> "Draw":
        """A draw of a whole batch that exists, [L, n], or of places [L, ...] of it."""
        entries = sorted(batch.items(True, True), key=lambda entry: str(entry[0]))
        columns = [*(column for _, column in entries), *place]
        gather = _OfBatch(tuple(name for name, _ in entries), tuple(batch.batch_size))
        return cls(gather, columns, tuple((column.shape, column.dtype) for column in columns))


class _OfBatch(NamedTuple):
    """Puts a batch together again: the names of its entries, and its batch size [L, n]. It takes places
    [L, ...] of it, if they are a last column."""

    names: tuple[Any, ...]
    size: tuple[int, ...]

    def __call__(self, columns: Sequence[Tensor]) -> TensorDict:
        batch = TensorDict({}, batch_size=self.size)
        for name, column in zip(self.names, columns, strict=False):
            batch.set(name, column)
        if len(columns) == len(self.names):
            return batch
        place = columns[-1]
        lane = torch.arange(len(place), device=place.device).view(-1, *[1] * (place.ndim - 1))
        taken: TensorDict = batch[lane, place]
        return taken
