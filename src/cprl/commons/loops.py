"""The loops over worlds that a thread runs, on the CPU or the GPU. Each rule works on one world.

`law` is what institutions need, None without any.
"""

from typing import Any, Final, Literal, get_args

from cprl.commons.tables import Tables
from cprl.commons.turn import begin_episode, play_turn, refresh_output
from cprl.commons.views import draw_board
from cprl.commons.world import Actions, Bools, Bytes, Scratch, StepOutput, Worlds
from cprl.institutions.arrays import slicer
from cprl.institutions.memory import Law, Memory, Payments

one_world, one_output, one_scratch = slicer(Worlds), slicer(StepOutput), slicer(Scratch)
one_memory, one_payments = slicer(Memory), slicer(Payments)


def one_law(law: Law | None, b: int) -> Any:
    """What institutions need in world b, without the axis B; shares memory."""
    if law is None:
        return None
    return Law(law.rules, one_memory(law.memory, b), law.decisions[b], one_payments(law.payments, b))


def play_worlds(
    worlds: Worlds,
    tables: Tables,
    actions: Actions,
    output: StepOutput,
    law: Law | None,
    scratch: Scratch,
    first: int,
    last: int,
) -> None:
    """Plays one turn of the worlds first .. last - 1; `actions`: int64 [B, N]."""
    for b in range(first, last):
        play_turn(one_world(worlds, b), tables, actions[b], one_output(output, b), one_law(law, b), scratch)


def begin_worlds(
    worlds: Worlds,
    tables: Tables,
    which: Bools,
    output: StepOutput,
    law: Law | None,
    scratch: Scratch,
    first: int,
    last: int,
) -> None:
    """Begins the next episode of the worlds among first .. last - 1 where `which`, bool [B], is true."""
    for b in range(first, last):
        if which[b]:
            begin_episode(one_world(worlds, b), tables, one_output(output, b), one_law(law, b), scratch)


def refresh_worlds(
    worlds: Worlds,
    tables: Tables,
    which: Bools,
    output: StepOutput,
    law: Law | None,
    scratch: Scratch,
    first: int,
    last: int,
) -> None:
    """Writes the output for a state set from outside, for the worlds among first .. last - 1 where `which`,
    bool [B], is true."""
    for b in range(first, last):
        if which[b]:
            refresh_output(one_world(worlds, b), tables, one_output(output, b), one_law(law, b), scratch)


def show_worlds(
    worlds: Worlds,
    tables: Tables,
    boards: Bytes,
    output: StepOutput,
    law: Law | None,
    scratch: Scratch,
    first: int,
    last: int,
) -> None:
    """Draws the boards of the worlds first .. last - 1; `boards`: uint8 [B, H, W], classes of cells."""
    for b in range(first, last):
        draw_board(one_world(worlds, b), tables, scratch, boards[b])


def first_unknown(actions: Actions, known: int) -> int:
    """The index of the first action outside 0 .. known - 1, -1 if there is none; `actions`: int64 [count]."""
    for n in range(actions.shape[0]):
        if actions[n] < 0 or actions[n] >= known:
            return n
    return -1


Loop = Literal["play_worlds", "begin_worlds", "refresh_worlds", "show_worlds"]
LOOPS: Final[tuple[Loop, ...]] = get_args(Loop)
"""The loops that drivers run; all have the same parameters except the third."""
ENTRIES: Final = (*(globals()[loop] for loop in LOOPS), first_unknown)
"""What drivers call; all other rules are called by these."""
