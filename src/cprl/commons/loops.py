"""The loops over worlds that a thread runs, on the CPU or the GPU. Each rule works on one world.

Playing, beginning and refreshing are tasks of one loop, so that what they share is compiled once.
"""

from typing import Final, NamedTuple

from cprl.commons.tables import Tables
from cprl.commons.turn import run_world
from cprl.commons.views import draw_board
from cprl.commons.world import Scratch, StepOutput, Worlds
from cprl.institutions import Law
from cprl.institutions.arrays import slicer
from cprl.values.arrays import Bool, Int64, UInt8

one_world, one_output, one_law = slicer(Worlds), slicer(StepOutput), slicer(Law)
one_scratch = slicer(Scratch, every=True)


class Played(NamedTuple):
    """What `run_worlds` works on."""

    worlds: Worlds
    tables: Tables
    output: StepOutput
    law: Law | None
    """None without institutions."""
    actions: Int64
    """int64 [B, N]"""
    decisions: Int64
    """int64 [B, N]"""
    which: Bool
    """bool [B], the worlds that the task is done with."""


def run_worlds(game: Played, task: int, scratch: Scratch, first: int, last: int) -> None:
    """Do a task with those of the worlds first .. last - 1 that `game.which` names; see `run_world`."""
    for b in range(first, last):
        if game.which[b]:
            world, output, law = one_world(game.worlds, b), one_output(game.output, b), one_law(game.law, b)
            run_world(world, game.tables, task, game.actions[b], game.decisions[b], output, law, scratch)


def show_worlds(game: tuple[Worlds, Tables, UInt8], scratch: Scratch, first: int, last: int) -> None:
    """Draw the boards of the worlds first .. last - 1, uint8 [B, H, W], classes of cells."""
    worlds, tables, boards = game
    for b in range(first, last):
        draw_board(one_world(worlds, b), tables, scratch, boards[b])


def first_unknown(actions: Int64, known: int) -> int:
    """Return the index of the first action outside 0 .. known - 1, -1 if there is none; `actions`: int64
    [count]."""
    for n in range(actions.shape[0]):
        if actions[n] < 0 or actions[n] >= known:
            return n
    return -1


ENTRIES: Final = (run_worlds, show_worlds, first_unknown)
"""What drivers call; all other rules are called by these."""
