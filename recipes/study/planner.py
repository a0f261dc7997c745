"""planned_harvest: what a planner that sees all and harvests for the group gets, a lower bound of the best.

An apple is worth 1 now; taking it changes how fast the board grows, for as long as the planner looks ahead.
It is ripe if that costs less than it is worth. Agents are sent to ripe apples one after the other, the one
with the shortest way first, around apples that are to stay; the others wait beside empty sites. Nobody fires.
Near the end of the episode less and less growth is worth keeping.

It is a rule of thumb, not an optimum: nobody has shown that more cannot be got; what certainly cannot, see
`yield_bounds`.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Annotated, Any, Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase

from cprl import keys
from cprl.commons.compiled import kept_on_disk
from cprl.commons.game import Game
from cprl.commons.headings import COL_STEP, ROW_STEP
from cprl.commons.moves import WALK_TURN
from cprl.commons.near import neighbours
from cprl.envs.commons_env import CommonsEnv
from cprl.measuring.evaluate import evaluate
from cprl.values import Range, Value

Array = NDArray[Any]

FAR: Final = 1 << 30


def harvests(env: CommonsEnv, choose: Callable[[CommonsEnv], Array]) -> NDArray[np.float64]:
    """Return the collective harvest of the next episode of each world, float64 [B], in apples.

    Args:
        env: B worlds.
        choose: the actions of all agents, int64 [B, N], asked for in each turn until all worlds have ended.
    """

    def policy(moment: TensorDictBase) -> TensorDictBase:
        return moment.set(keys.ACTION, torch.from_numpy(choose(env)))

    return np.array([np.sum(episode.harvest) for episode in evaluate(env, policy)], np.float64)


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
    """The numbers of a planner, see `Planner`, and the turns that are left."""

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


SEED: Final = 50_021
"""Of the worlds in which harvests are measured; no training of ours uses it."""
_SEED_OF_CHOICE: Final = 50_023
"""Of those in which the best candidate is chosen."""

Values = NDArray[np.float64]

Weight = Annotated[float, Range(0, 1e9)]


@dataclass(frozen=True, kw_only=True)
class Planner(Value):
    """The numbers that a planner weighs by.

    Raises:
        ValueError: names the field, its value and what is allowed.
    """

    patience_steps: Annotated[float, Range(1, 1e9)] = 160.0
    """For how many turns a change of the growth counts; fewer near the end of an episode."""
    growth_weight_steps: Weight = 20.0
    """How many steps further an agent goes for an apple whose taking adds 1 apple a turn to the growth."""
    haste_steps: Weight = 15.0
    """How many turns before the end of an episode nothing is left to grow any more."""


CANDIDATES: Final = tuple(Planner(growth_weight_steps=weight) for weight in (0.0, 20.0, 60.0, 200.0))
"""Those of which `best_planner` takes the best; none is best on all boards."""


def planned_harvest(
    game: Game, planner: Planner | None = None, *, episodes: int = 20, seed: int = SEED
) -> Values:
    """The collective harvest of episodes in which a planner leads all agents, float64 [E], in apples.

    Institutions and what agents observe are left out: what counts is what the board gives.

    Args:
        game: the game.
        planner: by default `best_planner(game)`.
        episodes: E; episode e is the first one of world e.
        seed: of the worlds.
    """
    game = replace(game, institutions=())
    lead = _Lead(game, planner or best_planner(game))
    return harvests(CommonsEnv(game, episodes, seed=seed), lead)


@cache
def best_planner(game: Game) -> Planner:
    """The candidate that harvests most in 10 episodes, in other worlds than those of `planned_harvest`."""
    found = [planned_harvest(game, own, episodes=10, seed=_SEED_OF_CHOICE).mean() for own in CANDIDATES]
    return CANDIDATES[int(np.argmax(found))]


class _Lead:
    """A planner that leads the agents of a game."""

    def __init__(self, game: Game, planner: Planner) -> None:
        self.game, self.planner = game, planner
        self._board = _board_of(game)
        sites, cells, agents = len(game.map.sites), self._board.site_at.shape, game.agents
        self._desk = Desk(
            counts=np.zeros(sites, np.int64),
            growth=np.zeros(sites),
            is_ripe=np.zeros(sites, np.bool_),
            is_taken=np.zeros(sites, np.bool_),
            is_sent=np.zeros(agents, np.bool_),
            is_occupied=np.zeros(cells, np.bool_),
            steps=np.zeros((agents, *cells), np.int32),
            queue=np.zeros((cells[0] * cells[1], 2), np.int32),
        )

    def __call__(self, env: CommonsEnv) -> NDArray[np.int64]:
        """The actions of all agents, int64 [B, N]."""
        state = env.worlds.state()
        actions = np.full(state["row"].shape, len(self.game.actions) - 1, np.int64)  # the last one stays
        for world, step in enumerate(state["step"][:, 0]):
            plan = Plan(
                patience=self.planner.patience_steps,
                growth_weight=self.planner.growth_weight_steps,
                left=float(self.game.rules.episode_steps - step - self.planner.haste_steps),
            )
            agents = Agents(*(state[name][world] for name in Agents._fields))
            decide(self._board, state["stock"][world], agents, plan, self._desk, actions[world])
        return actions


def _board_of(game: Game) -> Board:
    board = game.map
    first, near = neighbours(board, game.rules)
    rows, cols = np.array(board.sites, np.int64).T.copy()
    site_at = np.full((board.height, board.width), -1, np.int64)
    site_at[rows, cols] = np.arange(len(rows))
    is_wall = np.zeros(site_at.shape, np.bool_)
    for row, col in board.walls:
        is_wall[row, col] = True
    probs = np.array(game.rules.regrow_prob, np.float64)
    return Board(first, near.astype(np.int64), probs, rows, cols, site_at, is_wall)
