"""The order of a turn, on ONE world."""

import numpy as np

from cprl.commons import apples, beam, chance, moves, views
from cprl.commons.apples import bite, draw, fill, find_sprouts, grow, recount
from cprl.commons.beam import find_hits, tag
from cprl.commons.chance import STARTS
from cprl.commons.moves import act, count_down, put_at_start, return_to_play, settle_clashes, settle_pairwise
from cprl.commons.tables import Tables
from cprl.commons.views import draw_windows
from cprl.commons.world import PLAYING, TERMINATED, TRUNCATED, Actions, Scratch, StepOutput, Worlds


def play_turn(world: Worlds, tables: Tables, actions: Actions, output: StepOutput, scratch: Scratch) -> None:
    """One turn; `actions`: int64 [N]. A world that has ended stays as it is and pays nothing."""
    if world.ended[0] != PLAYING:
        write_nothing_happened(output)
        write_state(world, tables, output, scratch)
        return
    began_empty = world.stock_left[0] == 0
    keep_old_stock(world, tables)
    world.step[0] += 1
    count_down(world)
    act(world, tables, actions, scratch)
    if tables.pairwise_clashes:
        settle_pairwise(world, scratch)
    else:
        settle_clashes(world, scratch)
    sprouts = find_sprouts(world, tables, scratch)
    if tables.regrow_before_bites:
        grow(world, tables, scratch, sprouts)
        bite(world, tables, output.harvest)
    else:
        bite(world, tables, output.harvest)
        grow(world, tables, scratch, sprouts)
    output.regrown[0] = sprouts
    find_hits(world, tables, output.hit_by)
    tag(world, tables, output.hit_by, output.tagged_by)
    judge_the_end(world, tables, began_empty)
    for i in range(world.row.shape[0]):
        output.fired[i] = world.fired[i]
        world.on_board[i] = world.in_play[i]
    return_to_play(world, tables, scratch)
    write_state(world, tables, output, scratch)


def shuffle_starts(world: Worlds) -> None:
    """Agents change places, each order equally likely: from the last on, each with one of those up to it
    (Durstenfeld, "Algorithm 235: Random permutation", 1964)."""
    for i in range(world.row.shape[0] - 1, 0, -1):
        word, _, _, _ = draw(world, STARTS | i)
        j = int(word % np.uint64(i + 1))
        world.row[i], world.row[j] = world.row[j], world.row[i]
        world.col[i], world.col[j] = world.col[j], world.col[i]
        world.heading[i], world.heading[j] = world.heading[j], world.heading[i]


def begin_episode(world: Worlds, tables: Tables, output: StepOutput, scratch: Scratch) -> None:
    """The next episode of a world: full stock, everybody at the start."""
    world.episode[0] += 1
    world.step[0] = 0
    world.ended[0] = PLAYING
    fill(world, tables)
    put_at_start(world, tables)
    if tables.shuffle_starts:
        shuffle_starts(world)
    write_nothing_happened(output)
    write_state(world, tables, output, scratch)


def look_again(world: Worlds, tables: Tables, output: StepOutput, scratch: Scratch) -> None:
    """Tells of a state that was put in from outside; nothing is said to have happened."""
    recount(world, tables)
    write_nothing_happened(output)
    write_state(world, tables, output, scratch)


def keep_old_stock(world: Worlds, tables: Tables) -> None:
    """Remembers the stock as the turn begins, where the picture will show it."""
    if tables.picture_shows_old_stock:
        for k in range(world.stock.shape[0]):
            world.stock_before[k] = world.stock[k]


def judge_the_end(world: Worlds, tables: Tables, began_empty: bool) -> None:
    """TERMINATED if no apple is left and none can come, else TRUNCATED if the clock ran out."""
    is_empty = began_empty if tables.ends_one_turn_late else world.stock_left[0] == 0
    if is_empty and tables.never_from_nothing:
        world.ended[0] = TERMINATED
    elif world.step[0] >= tables.episode_steps:
        world.ended[0] = TRUNCATED


def write_nothing_happened(output: StepOutput) -> None:
    """A turn without harvest, shots, hits and growth."""
    agents = output.harvest.shape[0]
    for i in range(agents):
        output.harvest[i] = 0.0
        output.fired[i] = False
        for j in range(agents):
            output.hit_by[i, j] = False
            output.tagged_by[i, j] = False
    output.regrown[0] = 0


def write_state(world: Worlds, tables: Tables, output: StepOutput, scratch: Scratch) -> None:
    """How the world stands now, and what everybody sees of it."""
    for i in range(world.row.shape[0]):
        output.in_play[i] = world.in_play[i]
        for j in range(output.scoreboard.shape[1]):
            output.scoreboard[i, j] = world.harvested[(i + j) % world.row.shape[0]]
        if output.stock_gauge.shape[1] > 0:
            output.stock_gauge[i, 0] = world.stock_left[0] / world.stock.shape[0]
    output.stock[0] = world.stock_left[0]
    output.terminated[0] = world.ended[0] == TERMINATED
    output.truncated[0] = world.ended[0] == TRUNCATED
    output.done[0] = world.ended[0] != PLAYING
    draw_windows(world, tables, scratch, output.observation)


FUNCTIONS = (
    chance.philox4x32,
    *moves.FUNCTIONS,
    *beam.FUNCTIONS,
    *apples.FUNCTIONS,
    *views.FUNCTIONS,
    keep_old_stock,
    judge_the_end,
    write_nothing_happened,
    write_state,
    play_turn,
    shuffle_starts,
    begin_episode,
    look_again,
)
"""All rules in the order in which they call each other, as `compiled.py` compiles them."""
