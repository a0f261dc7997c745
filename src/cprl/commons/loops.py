"""The loops over worlds that a thread runs, on the CPU or the GPU. Each rule works on one world."""

from typing import Final, Literal, get_args

from cprl.commons import institution_turn, turn
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
from cprl.institutions.memory import Memory, Payments


def one_world(w: Worlds, b: int) -> Worlds:
    """World b without the axis B; shares memory."""
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
        w.moved_after_firing[b],
        w.hits[b],
        w.tagged_step[b],
        w.offences[b],
        w.harvested[b],
        w.step[b],
        w.episode[b],
        w.ended[b],
    )


def one_output(o: StepOutput, b: int) -> StepOutput:
    """The output of world b without the axis B; shares memory."""
    return StepOutput(
        o.observation[b],
        o.harvest[b],
        o.in_play[b],
        o.fired[b],
        o.hit_by[b],
        o.tagged_by[b],
        o.scoreboard[b],
        o.stock_gauge[b],
        o.stock[b],
        o.regrown[b],
        o.terminated[b],
        o.truncated[b],
        o.done[b],
    )


def one_memory(m: Memory, b: int) -> Memory:
    """What institutions remember of world b, without the axis B; shares memory."""
    return Memory(
        m.in_force[b],
        m.allowed[b],
        m.taken[b],
        m.income[b],
        m.level[b],
        m.offence_step[b],
        m.violation_step[b],
        m.may_fire[b],
        m.detected[b],
        m.closed[b],
        m.counts[b],
        m.sanctioned[b],
        m.broke[b],
        m.unjust[b],
        m.due[b],
        m.fines[b],
        m.transfers[b],
        m.owed[b],
        m.patch_stock[b],
    )


def one_payments(p: Payments, b: int) -> Payments:
    """The payments of world b without the axis B; shares memory."""
    return Payments(
        p.reward[b],
        p.fines[b],
        p.transfers[b],
        p.violated[b],
        p.counts[b],
        p.in_force[b],
        p.ballots_due[b],
    )


def one_scratch(s: Scratch, b: int) -> Scratch:
    """The scratch memory of world b, where each world has its own; shares memory."""
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


FUNCTIONS = (
    *turn.FUNCTIONS,
    *institution_turn.FUNCTIONS,
    one_world,
    one_output,
    one_memory,
    one_payments,
    one_scratch,
    play_worlds,
    begin_worlds,
    show_worlds,
    refresh_worlds,
    play_governed_worlds,
    begin_governed_worlds,
    refresh_governed_worlds,
    first_unknown,
)
"""All rules and loops, each after those it calls."""

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
