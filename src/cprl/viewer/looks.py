"""Looks: copies of the state of the worlds, taken step by step and added up many at once."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cprl.envs.commons_env import CommonsEnv

ROOM: Final = 100
"""Looks that are kept, at most."""


class Looks:
    """Keeps some arrays of the worlds as they are at some steps.

    A copy takes a microsecond; adding up right away takes twenty, since whatever runs between two steps of a
    training runs out of cold caches.

    Args:
        env: the worlds.
        names: the arrays, by their names in `cprl.commons.world.Worlds`.
    """

    def __init__(self, env: CommonsEnv, names: Sequence[str]) -> None:
        self._read = env.worlds.driver.read
        arrays = [getattr(env.worlds.now, name) for name in names]
        self._pairs = [(array, np.empty((ROOM, *array.shape), array.dtype)) for array in arrays]
        self._on_cpu = all(isinstance(array, np.ndarray) for array in arrays)
        self._count = 0

    @property
    def is_full(self) -> bool:
        """Whether `take` must be called before `add`."""
        return self._count == ROOM

    def add(self) -> None:
        """Copies the arrays as they are now."""
        at = self._count
        self._count = at + 1
        for array, kept in self._pairs:
            kept[at] = array if self._on_cpu else self._read(array)

    def take(self) -> list[NDArray[Any]]:
        """The copies [T, ...] of each array, good until the next `add`; there are none afterwards."""
        count, self._count = self._count, 0
        return [kept[:count] for _, kept in self._pairs]
