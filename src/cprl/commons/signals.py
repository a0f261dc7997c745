"""Signals that agents send with their actions: a group of rules. The rules work on one world.

A game without signals is compiled without the code of this group.
"""

from typing import TYPE_CHECKING, Any, NamedTuple

from cprl.commons.moves import cell_of
from cprl.commons.views import look
from cprl.values.array_types import UInt8

if TYPE_CHECKING:
    from cprl.commons.tables import Tables
    from cprl.commons.world import Scratch, Worlds


class Arrays(NamedTuple):
    """The numbers of a game with signals."""

    kinds: int
    """The number of different signals."""
    silent_actions: int
    """The number of actions that send no signal."""
    first_plane: int
    """The index of the channel that shows the first signal."""


def parameters(game: Any) -> dict[str, Any]:
    """Return the numbers in `Arrays` by name."""
    return {
        "kinds": game.rules.signals,
        "silent_actions": game.tables.silent_actions,
        "first_plane": len(game.cell_channels),
    }


def without_signal(action: int, signals: Arrays | None) -> int:
    """Return an action without the signal that the agent sends with it."""
    if signals is None:
        return action
    return action % signals.silent_actions


def send_signal(world: "Worlds", signals: Arrays | None, i: int, action: int) -> None:
    """Note the signal that agent i sends with its action; agents out of play send none."""
    if signals is not None:
        world.signal[i] = action // signals.silent_actions if world.in_play[i] else 0


def draw_signals(
    world: "Worlds", tables: "Tables", signals: Arrays | None, scratch: "Scratch", observation: UInt8
) -> None:
    """Write a plane for each signal, with the agents that sent it in the last turn.

    `observation`: uint8 [N, C, X, Y]. This runs after `draw_windows` and writes the numbers of signals over
    the agents in the picture. No paint is one of these small numbers, so they cannot be mistaken for paints.
    """
    if signals is None:
        return
    picture = scratch.picture
    for i in range(world.row.shape[0]):
        if world.on_board[i] and world.signal[i] > 0:
            picture[cell_of(world.row[i], world.col[i], tables)] = world.signal[i]
    cells = tables.window_cells.shape[1]
    for i in range(world.row.shape[0]):
        look(world, tables, i, scratch)
        planes = observation[i].reshape(-1)
        for s in range(signals.kinds):
            first = (signals.first_plane + s) * cells
            for n in range(cells):
                planes[first + n] = (scratch.seen[n] == s + 1) * tables.highest
