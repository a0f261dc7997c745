"""Signals that agents send with their actions: a group of rules. The rules work on one world.

A game without signals is compiled without the code of this group.
"""

from typing import TYPE_CHECKING, Any, NamedTuple

from cprl.commons.moves import cell_of
from cprl.commons.views import copy_window
from cprl.values.array_types import UInt8

if TYPE_CHECKING:
    from cprl.commons.tables import Tables
    from cprl.commons.world import Scratch, Worlds


class SignalArrays(NamedTuple):
    """The numbers of a game with signals."""

    signal_count: int
    """The number of different signals."""
    silent_actions: int
    """The number of actions that send no signal."""
    first_plane: int
    """The index of the channel that shows the first signal."""


def parameters(game: Any) -> dict[str, Any]:
    """Return the numbers in `SignalArrays` by name."""
    return {
        "signal_count": game.rules.signals,
        "silent_actions": game.tables.silent_actions,
        "first_plane": len(game.cell_channels),
    }


def without_signal(action: int, signals: SignalArrays | None) -> int:
    """Return an action without the signal that the agent sends with it."""
    if signals is None:
        return action
    return action % signals.silent_actions


def send_signal(world: "Worlds", signals: SignalArrays | None, agent: int, action: int) -> None:
    """Note the signal that an agent sends with its action; agents out of play send none."""
    if signals is not None:
        world.signal[agent] = action // signals.silent_actions if world.in_play[agent] else 0


def draw_signals(
    world: "Worlds", tables: "Tables", signals: SignalArrays | None, scratch: "Scratch", observation: UInt8
) -> None:
    """Write a plane for each signal, with the agents that sent it in the last turn.

    `observation`: uint8 [N, C, X, Y]. This runs after `draw_windows` and writes the numbers of signals over
    the agents in the picture. No paint is one of these small numbers, so they cannot be mistaken for paints.
    """
    if signals is None:
        return
    picture = scratch.picture
    for agent in range(world.row.shape[0]):
        if world.on_board[agent] and world.signal[agent] > 0:
            picture[cell_of(world.row[agent], world.col[agent], tables)] = world.signal[agent]
    cells = tables.window_cells.shape[1]
    for agent in range(world.row.shape[0]):
        copy_window(world, tables, agent, scratch)
        planes = observation[agent].reshape(-1)
        for signal in range(signals.signal_count):
            first = (signals.first_plane + signal) * cells
            for window_cell in range(cells):
                planes[first + window_cell] = (scratch.seen[window_cell] == signal + 1) * tables.highest
