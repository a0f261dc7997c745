"""The memory that B worlds take, checked before it is allocated."""

from math import prod
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cprl import memory
from cprl.commons.game import Game, output_shapes
from cprl.commons.world import empty_worlds
from cprl.institutions.memory import empty_memory

OUTPUTS_HELD: Final = 3
"""The step outputs that an environment holds at once, at least: the current one, the next, and a copy."""


def bytes_of_worlds(game: Game, worlds: int) -> int:
    """The bytes that B worlds take at least: their state, and `OUTPUTS_HELD` step outputs."""
    of_world: list[NDArray[Any]] = [
        *empty_worlds(worlds=1, agents=game.agents, sites=len(game.map.sites)),
        *(empty_memory(game.governed_tables.institutions, worlds=1) if game.institutions else ()),
    ]
    outputs = sum(prod(shape) * np.dtype(dtype).itemsize for shape, dtype in output_shapes(game, 1).values())
    return worlds * (sum(array.nbytes for array in of_world) + OUTPUTS_HELD * outputs)


def check_worlds_fit(game: Game, worlds: int, *, free: int | None = None) -> None:
    """Checks that B worlds fit into memory, before it is allocated.

    Args:
        game: The game.
        worlds: The number of worlds B.
        free: Bytes of free memory; None for those of this machine's main memory.

    Raises:
        MemoryError: If they do not fit.
    """
    memory.check_memory(
        f"worlds is {worlds:,}: {'their arrays' if worlds > 1 else 'its arrays'}",
        bytes_of_worlds(game, worlds),
        "fewer worlds, or a smaller map, window or number of agents",
        free=free,
    )
