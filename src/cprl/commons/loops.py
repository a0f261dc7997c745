"""The loops over worlds that a thread runs, on the CPU or on the GPU; the rules themselves know ONE world."""

from typing import Final, Literal, get_args

from cprl.commons import turn
from cprl.commons.tables import Tables
from cprl.commons.turn import begin_episode, look_again, play_turn
from cprl.commons.views import draw_board
from cprl.commons.world import Actions, Bools, Bytes, Scratch, StepOutput, Worlds


def one_world(w: Worlds, b: int) -> Worlds:
    """World b without the axis B, sharing memory."""
    return Worlds(
        w.seed[b],
        w.number[b],
        w.stock[b],
        w.stock_before[b],
        w.near[b],
        w.stock_left[b],
        w.row[b],
        w.col[b],
        w.heading[b],
        w.out_steps[b],
        w.in_play[b],
        w.on_board[b],
        w.fired[b],
        w.hits[b],
        w.tagged_step[b],
        w.offences[b],
        w.harvested[b],
        w.step[b],
        w.episode[b],
        w.ended[b],
    )


def one_told(t: StepOutput, b: int) -> StepOutput:
    """What is told of world b, without the axis B, sharing memory."""
    return StepOutput(
        t.observation[b],
        t.harvest[b],
        t.in_play[b],
        t.fired[b],
        t.hit_by[b],
        t.tagged_by[b],
        t.scoreboard[b],
        t.stock_gauge[b],
        t.stock[b],
        t.regrown[b],
        t.terminated[b],
        t.truncated[b],
        t.done[b],
    )


def one_scratch(s: Scratch, b: int) -> Scratch:
    """World b's own sheet, where each world has one."""
    return Scratch(
        s.start_row[b],
        s.start_col[b],
        s.blocked[b],
        s.words[b],
        s.sprouts[b],
        s.picture[b],
        s.seen[b],
    )


def play_worlds(
    worlds: Worlds,
    tables: Tables,
    actions: Actions,
    output: StepOutput,
    scratch: Scratch,
    first: int,
    last: int,
) -> None:
    """One turn of the worlds first .. last - 1; `actions`: int64 [B, N]."""
    for b in range(first, last):
        play_turn(one_world(worlds, b), tables, actions[b], one_told(output, b), scratch)


def begin_worlds(
    worlds: Worlds,
    tables: Tables,
    which: Bools,
    output: StepOutput,
    scratch: Scratch,
    first: int,
    last: int,
) -> None:
    """The next episode of those of the worlds first .. last - 1 that are marked; `which`: bool [B]."""
    for b in range(first, last):
        if which[b]:
            begin_episode(one_world(worlds, b), tables, one_told(output, b), scratch)


def show_worlds(
    worlds: Worlds,
    tables: Tables,
    boards: Bytes,
    output: StepOutput,
    scratch: Scratch,
    first: int,
    last: int,
) -> None:
    """The whole boards of the worlds first .. last - 1; `boards`: uint8 [B, H, W], colour classes."""
    for b in range(first, last):
        draw_board(one_world(worlds, b), tables, scratch, boards[b])


def look_at_worlds(
    worlds: Worlds,
    tables: Tables,
    which: Bools,
    output: StepOutput,
    scratch: Scratch,
    first: int,
    last: int,
) -> None:
    """Tells of the marked worlds of first .. last - 1 as they were put in; `which`: bool [B]."""
    for b in range(first, last):
        if which[b]:
            look_again(one_world(worlds, b), tables, one_told(output, b), scratch)


def first_unknown(actions: Actions, known: int) -> int:
    """The index of the first action outside 0 .. known - 1, or -1; `actions`: int64 [count]."""
    for n in range(actions.shape[0]):
        if actions[n] < 0 or actions[n] >= known:
            return n
    return -1


FUNCTIONS = (
    *turn.FUNCTIONS,
    one_world,
    one_told,
    one_scratch,
    play_worlds,
    begin_worlds,
    show_worlds,
    look_at_worlds,
    first_unknown,
)
"""All rules and loops in the order in which they call each other."""

Loop = Literal["play_worlds", "begin_worlds", "show_worlds", "look_at_worlds"]
LOOPS: Final[tuple[Loop, ...]] = get_args(Loop)
"""The loops that drivers run, all with the same arguments."""
