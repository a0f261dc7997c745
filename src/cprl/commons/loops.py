"""The loops over worlds that a thread runs, on the CPU or the GPU. Each rule works on one world."""

from typing import Any, Final, Literal, NamedTuple, get_args

from cprl.commons.tables import Tables
from cprl.commons.turn import begin_episode, play_turn, refresh_output
from cprl.commons.views import draw_board
from cprl.commons.world import Actions, Bools, Bytes, Scratch, StepOutput, Worlds
from cprl.institutions import Law
from cprl.institutions.arrays import slicer
from cprl.institutions.law import one_law
from cprl.institutions.ledger import Payments

one_world, one_output = slicer(Worlds), slicer(StepOutput)
one_scratch = slicer(Scratch, every=True)


class Played(NamedTuple):
    """What loops work on."""

    worlds: Worlds
    tables: Tables
    output: StepOutput
    law: Law | None
    """None without institutions, as are all that follow."""
    decisions: Actions | None
    payments: Payments | None


def law_of(game: Played, b: int) -> Any:
    """What institutions need in world b, without the axis B; shares memory."""
    return one_law(game.law, game.decisions, game.payments, b)


def play_worlds(game: Played, actions: Actions, scratch: Scratch, first: int, last: int) -> None:
    """Plays one turn of the worlds first .. last - 1; `actions`: int64 [B, N]."""
    for b in range(first, last):
        world, output, law = one_world(game.worlds, b), one_output(game.output, b), law_of(game, b)
        play_turn(world, game.tables, actions[b], output, law, scratch)


def begin_worlds(game: Played, which: Bools, scratch: Scratch, first: int, last: int) -> None:
    """Begins the next episode of the worlds among first .. last - 1 where `which`, bool [B], is true."""
    for b in range(first, last):
        if which[b]:
            world, output, law = one_world(game.worlds, b), one_output(game.output, b), law_of(game, b)
            begin_episode(world, game.tables, output, law, scratch)


def refresh_worlds(game: Played, which: Bools, scratch: Scratch, first: int, last: int) -> None:
    """Writes the output for a state set from outside, for the worlds among first .. last - 1 where `which`,
    bool [B], is true."""
    for b in range(first, last):
        if which[b]:
            world, output, law = one_world(game.worlds, b), one_output(game.output, b), law_of(game, b)
            refresh_output(world, game.tables, output, law, scratch)


def show_worlds(game: Played, boards: Bytes, scratch: Scratch, first: int, last: int) -> None:
    """Draws the boards of the worlds first .. last - 1; `boards`: uint8 [B, H, W], classes of cells."""
    for b in range(first, last):
        draw_board(one_world(game.worlds, b), game.tables, scratch, boards[b])


def first_unknown(actions: Actions, known: int) -> int:
    """The index of the first action outside 0 .. known - 1, -1 if there is none; `actions`: int64 [count]."""
    for n in range(actions.shape[0]):
        if actions[n] < 0 or actions[n] >= known:
            return n
    return -1


Loop = Literal["play_worlds", "begin_worlds", "refresh_worlds", "show_worlds"]
LOOPS: Final[tuple[Loop, ...]] = get_args(Loop)
"""The loops that drivers run; all have the same parameters except the second."""
ENTRIES: Final = (*(globals()[loop] for loop in LOOPS), first_unknown)
"""What drivers call; all other rules are called by these."""
