"""The loops over worlds that a thread runs, on the CPU or the GPU. Each rule works on one world."""

from typing import Final, Literal, get_args

from cprl.commons.institution_turn import begin_governed_episode, play_governed_turn, refresh_governed_output
from cprl.commons.tables import GovernedTables, Tables
from cprl.commons.turn import begin_episode, play_turn, refresh_output
from cprl.commons.views import draw_board
from cprl.commons.world import (
    Actions,
    Bools,
    Bytes,
    Governed,
    GovernedOutput,
    Scratch,
    StepOutput,
    Worlds,
)
from cprl.institutions.arrays import slicer
from cprl.institutions.memory import Memory, Payments

one_world, one_output, one_scratch = slicer(Worlds), slicer(StepOutput), slicer(Scratch)
one_memory, one_payments = slicer(Memory), slicer(Payments)


def play_worlds(
    worlds: Worlds,
    tables: Tables,
    actions: Actions,
    output: StepOutput,
    scratch: Scratch,
    first: int,
    last: int,
) -> None:
    """Plays one turn of the worlds first .. last - 1; `actions`: int64 [B, N]."""
    for b in range(first, last):
        play_turn(one_world(worlds, b), tables, actions[b], one_output(output, b), scratch)


def begin_worlds(
    worlds: Worlds,
    tables: Tables,
    which: Bools,
    output: StepOutput,
    scratch: Scratch,
    first: int,
    last: int,
) -> None:
    """Begins the next episode of the worlds among first .. last - 1 where `which`, bool [B], is true."""
    for b in range(first, last):
        if which[b]:
            begin_episode(one_world(worlds, b), tables, one_output(output, b), scratch)


def show_worlds(
    worlds: Worlds,
    tables: Tables,
    boards: Bytes,
    output: StepOutput,
    scratch: Scratch,
    first: int,
    last: int,
) -> None:
    """Draws the boards of the worlds first .. last - 1; `boards`: uint8 [B, H, W], classes of cells."""
    for b in range(first, last):
        draw_board(one_world(worlds, b), tables, scratch, boards[b])


def refresh_worlds(
    worlds: Worlds,
    tables: Tables,
    which: Bools,
    output: StepOutput,
    scratch: Scratch,
    first: int,
    last: int,
) -> None:
    """Writes the output for a state set from outside, for the worlds among first .. last - 1 where `which`,
    bool [B], is true."""
    for b in range(first, last):
        if which[b]:
            refresh_output(one_world(worlds, b), tables, one_output(output, b), scratch)


def play_governed_worlds(
    worlds: Governed,
    tables: GovernedTables,
    actions: Actions,
    output: GovernedOutput,
    scratch: Scratch,
    first: int,
    last: int,
) -> None:
    """`play_worlds` of a game with institutions."""
    for b in range(first, last):
        play_governed_turn(
            one_world(worlds.worlds, b),
            one_memory(worlds.memory, b),
            tables.game,
            tables.institutions,
            actions[b],
            worlds.decisions[b],
            one_output(output.turn, b),
            one_payments(output.payments, b),
            scratch,
        )


def begin_governed_worlds(
    worlds: Governed,
    tables: GovernedTables,
    which: Bools,
    output: GovernedOutput,
    scratch: Scratch,
    first: int,
    last: int,
) -> None:
    """`begin_worlds` of a game with institutions."""
    for b in range(first, last):
        if which[b]:
            begin_governed_episode(
                one_world(worlds.worlds, b),
                one_memory(worlds.memory, b),
                tables.game,
                tables.institutions,
                one_output(output.turn, b),
                one_payments(output.payments, b),
                scratch,
            )


def refresh_governed_worlds(
    worlds: Governed,
    tables: GovernedTables,
    which: Bools,
    output: GovernedOutput,
    scratch: Scratch,
    first: int,
    last: int,
) -> None:
    """`refresh_worlds` of a game with institutions."""
    for b in range(first, last):
        if which[b]:
            refresh_governed_output(
                one_world(worlds.worlds, b),
                one_memory(worlds.memory, b),
                tables.game,
                tables.institutions,
                one_output(output.turn, b),
                one_payments(output.payments, b),
                scratch,
            )


def first_unknown(actions: Actions, known: int) -> int:
    """The index of the first action outside 0 .. known - 1, -1 if there is none; `actions`: int64 [count]."""
    for n in range(actions.shape[0]):
        if actions[n] < 0 or actions[n] >= known:
            return n
    return -1


Loop = Literal[
    "play_worlds",
    "begin_worlds",
    "show_worlds",
    "refresh_worlds",
    "play_governed_worlds",
    "begin_governed_worlds",
    "refresh_governed_worlds",
]
LOOPS: Final[tuple[Loop, ...]] = get_args(Loop)
"""The loops that drivers run; all have the same parameters except the third."""
ENTRIES: Final = (*(globals()[loop] for loop in LOOPS), first_unknown)
"""What drivers call; all other rules are called by these."""
