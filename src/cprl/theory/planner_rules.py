"""What a planner decides in one world: which apples are ripe, who takes which, and the way there.

Plain loops for Numba. Cells are (row, column), directions are headings: 0 up, 1 right, 2 down, 3 left.
"""

from typing import Any, Final, NamedTuple

from numpy.typing import NDArray

from cprl.commons.compiled import kept_on_disk
from cprl.commons.moves import WALK_TURN
from cprl.commons.world import COL_STEP, ROW_STEP

Array = NDArray[Any]

FAR: Final = 1 << 30


def _jit(function: Any) -> Any:
    """Compiles a function, kept on disk where a folder for that is writable."""
    return kept_on_disk(function, nogil=True, error_model="numpy")


class Board(NamedTuple):
    """What does not change in a game of K sites on H x W cells."""

    first: Array
    near: Array
    """See `cprl.commons.near.neighbours`."""
    probs: Array
    """float64, the probability of growth by the number of apples near."""
    rows: Array
    cols: Array
    """int64 [K], the cells of the sites."""
    site_at: Array
    """int64 [H, W], the site of each cell, -1 where there is none."""
    is_wall: Array
    """bool [H, W]."""


class Agents(NamedTuple):
    """The N agents of a world, [N] each, as in `cprl.commons.world.Worlds`."""

    row: Array
    col: Array
    heading: Array
    in_play: Array


class Plan(NamedTuple):
    """The numbers of a planner, see `cprl.theory.planner.Planner`, and the turns that are left."""

    patience: float
    growth_weight: float
    left: float


class Desk(NamedTuple):
    """Working memory for one world."""

    counts: Array
    """int64 [K], the apples near each site."""
    growth: Array
    """float64 [K], by how much the growth of the board rises if the apple there is taken."""
    is_ripe: Array
    """bool [K]."""
    is_taken: Array
    """bool [K], whether somebody is on the way there."""
    is_sent: Array
    """bool [N], whether an agent has somewhere to go."""
    is_occupied: Array
    """bool [H, W]."""
    steps: Array
    """int32 [N, H, W], the length of each agent's way to each cell; `FAR` where there is none."""
    queue: Array
    """int32 [H * W, 2]."""


@_jit
def chance(board: Board, count: int) -> float:
    """The probability that an apple grows with so many near."""
    prob: float = board.probs[min(count, len(board.probs) - 1)]
    return prob


@_jit
def judge(board: Board, stock: Array, plan: Plan, desk: Desk) -> None:
    """Which apples are ripe: taking them costs less growth, as long as it lasts, than they are worth."""
    lasting = max(min(plan.left, plan.patience), 1.0)
    for site in range(len(stock)):
        desk.counts[site] = 0
        for place in range(board.first[site], board.first[site + 1]):
            desk.counts[site] += stock[board.near[place]]
    for site in range(len(stock)):
        desk.growth[site] = chance(board, desk.counts[site])
        for place in range(board.first[site], board.first[site + 1]):
            other = board.near[place]
            if not stock[other]:
                count = desk.counts[other]
                desk.growth[site] -= chance(board, count) - chance(board, count - 1)
        desk.is_ripe[site] = stock[site] and desk.growth[site] * lasting > -1.0


@_jit
def measure(board: Board, stock: Array, row: int, col: int, desk: Desk, steps: Array) -> None:
    """The lengths of an agent's ways: around walls, other agents and apples that are not ripe, and through no
    apple."""
    height, width = steps.shape
    steps[:] = FAR
    steps[row, col] = 0
    desk.queue[0] = row, col
    done, known = 0, 1
    while done < known:
        row, col = desk.queue[done]
        done += 1
        site = board.site_at[row, col]
        if site >= 0 and stock[site] and steps[row, col] > 0:
            continue
        for direction in range(4):
            r, c = row + ROW_STEP[direction], col + COL_STEP[direction]
            if r < 0 or c < 0 or r >= height or c >= width or steps[r, c] < FAR:
                continue
            there = board.site_at[r, c]
            spared = there >= 0 and stock[there] and not desk.is_ripe[there]
            if board.is_wall[r, c] or desk.is_occupied[r, c] or spared:
                continue
            steps[r, c] = steps[row, col] + 1
            desk.queue[known] = r, c
            known += 1


@_jit
def first_step(board: Board, stock: Array, goal: int, steps: Array) -> int:
    """The direction of the first step to a site that can be reached."""
    height, width = steps.shape
    row, col = board.rows[goal], board.cols[goal]
    while True:
        for direction in range(4):
            r, c = row - ROW_STEP[direction], col - COL_STEP[direction]
            if r < 0 or c < 0 or r >= height or c >= width or steps[r, c] != steps[row, col] - 1:
                continue
            if steps[r, c] == 0:
                return direction
            site = board.site_at[r, c]
            if site < 0 or not stock[site]:
                row, col = r, c
                break


@_jit
def send(
    board: Board, stock: Array, agents: Agents, plan: Plan, desk: Desk, to_ripe: bool, actions: Array
) -> None:
    """Sends agents who have nowhere to go, the one with the shortest way first, to ripe apples, or to wait
    beside empty sites."""
    while True:
        least, who, goal = float(FAR), -1, -1
        for agent in range(len(actions)):
            if desk.is_sent[agent] or not agents.in_play[agent]:
                continue
            for site in range(len(stock)):
                way = desk.steps[agent, board.rows[site], board.cols[site]]
                is_wanted = desk.is_ripe[site] and way > 0 if to_ripe else not stock[site]
                if desk.is_taken[site] or not is_wanted or way >= FAR:
                    continue
                cost = way - plan.growth_weight * desk.growth[site] if to_ripe else float(way)
                if cost < least:
                    least, who, goal = cost, agent, site
        if who < 0:
            return
        desk.is_sent[who] = desk.is_taken[goal] = True
        if to_ripe or desk.steps[who, board.rows[goal], board.cols[goal]] > 1:
            turn = (first_step(board, stock, goal, desk.steps[who]) - agents.heading[who]) % 4
            for action in range(4):
                if WALK_TURN[action] == turn:
                    actions[who] = action


@_jit
def decide(board: Board, stock: Array, agents: Agents, plan: Plan, desk: Desk, actions: Array) -> None:
    """The actions of all agents of a world, int64 [N]; those that go nowhere keep what is there."""
    judge(board, stock, plan, desk)
    desk.is_taken[:], desk.is_sent[:], desk.is_occupied[:] = False, False, False
    for agent in range(len(actions)):
        if agents.in_play[agent]:
            desk.is_occupied[agents.row[agent], agents.col[agent]] = True
    for agent in range(len(actions)):
        if agents.in_play[agent]:
            measure(board, stock, agents.row[agent], agents.col[agent], desk, desk.steps[agent])
    send(board, stock, agents, plan, desk, True, actions)
    send(board, stock, agents, plan, desk, False, actions)
