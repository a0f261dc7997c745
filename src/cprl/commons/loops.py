"""The loops over worlds that each thread runs, on the CPU or the GPU; drivers call these compiled functions.

The loops cut one world out of the arrays of all worlds and pass it to the rules. To play a turn, to begin an
episode and to refresh the output are tasks of one loop, so that the code that they share is compiled once.
"""

from typing import Final, NamedTuple

from cprl.commons.tables import Tables
from cprl.commons.turn import run_world
from cprl.commons.views import draw_board
from cprl.commons.world import Scratch, StepOutput, Worlds
from cprl.institutions import Law
from cprl.institutions.arrays import slicer
from cprl.values.array_types import Bool, Int64, UInt8

one_world = slicer(Worlds)
one_output = slicer(StepOutput)
one_law = slicer(Law)
one_scratch = slicer(Scratch, all_sliced=True)


class Played(NamedTuple):
    """The arrays of all B worlds on which `run_worlds` works."""

    worlds: Worlds
    tables: Tables
    output: StepOutput
    law: Law | None
    """None without institutions."""
    actions: Int64
    """int64 [B, N]"""
    decisions: Int64
    """int64 [B, N]"""
    selected: Bool
    """bool [B], True for worlds with which the task is done."""


def run_worlds(game: Played, task: int, scratch: Scratch, first: int, last: int) -> None:
    """Do a task with the selected worlds among first .. last - 1; see `run_world` for the tasks."""
    for index in range(first, last):
        if game.selected[index]:
            world = one_world(game.worlds, index)
            output = one_output(game.output, index)
            law = one_law(game.law, index)
            run_world(
                world, game.tables, task, game.actions[index], game.decisions[index], output, law, scratch
            )


def show_worlds(game: tuple[Worlds, Tables, UInt8], scratch: Scratch, first: int, last: int) -> None:
    """Draw the boards of the worlds first .. last - 1 into the last entry of `game`, uint8 [B, H, W], as
    classes of cells."""
    worlds, tables, boards = game
    for index in range(first, last):
        draw_board(one_world(worlds, index), tables, scratch, boards[index])


def first_invalid(actions: Int64, known: int) -> int:
    """Return the index of the first action outside 0 .. known - 1, or -1 if all are known; `actions`: int64,
    one axis."""
    for index in range(actions.shape[0]):
        if actions[index] < 0 or actions[index] >= known:
            return index
    return -1


ENTRIES: Final = (run_worlds, show_worlds, first_invalid)
"""The functions that drivers call; these call all rules."""
