"""How much can agents harvest together, if a planner that sees all leads them? A lower bound of the best.

An apple is worth 1 now; taking it changes how fast the board grows, for as long as the planner looks ahead.
It is ripe if that costs less than it is worth. Agents are sent to ripe apples one after the other, the one
with the shortest way first, around apples that are to stay; the others wait beside empty sites. Nobody fires.
Near the end of the episode less and less growth is worth keeping.

It is a rule of thumb, not an optimum: nobody has shown that more cannot be got; what certainly cannot, see
`yield_bounds`.
"""

from dataclasses import dataclass, replace
from functools import cache
from typing import Annotated, Any, Final

import numpy as np
from numpy.typing import NDArray
from random_play import harvests

from cprl.commons.game import Game
from cprl.commons.headings import COL_STEP, ROW_STEP
from cprl.commons.moves import WALK_TURN
from cprl.commons.near import neighbours
from cprl.envs.commons_env import CommonsEnv
from cprl.system.jit.disk_cache import compile_with_disk_cache
from cprl.values import Range, Value
from cprl.values.array_types import Bool, Float64

Array = NDArray[Any]

FAR: Final = 1 << 30
"""The length of a way that does not exist."""
SEED: Final = 50_021
"""The seed of the worlds in which harvests are measured; no training of ours uses it."""
_SEED_OF_CHOICE: Final = 50_023
"""The seed of the worlds in which the best candidate is chosen."""


def _jit(function: Any) -> Any:
    """Compile a function, and keep it on disk where a folder for that is writable."""
    return compile_with_disk_cache(function, nogil=True, error_model="numpy")


@_jit
def ways(row: int, col: int, is_closed: Array, has_apple: Array) -> Array:
    """Return the length of an agent's way to each cell, int64 [H, W]: around closed cells, past no apple."""
    height, width = is_closed.shape
    steps = np.full((height, width), FAR)
    steps[row, col] = 0
    reached = [(row, col)]
    done = 0
    while done < len(reached):
        row, col = reached[done]
        done += 1
        if has_apple[row, col] and steps[row, col] > 0:
            continue
        for direction in range(4):
            cell = (row + ROW_STEP[direction], col + COL_STEP[direction])
            is_inside = 0 <= cell[0] < height and 0 <= cell[1] < width
            if is_inside and steps[cell] == FAR and not is_closed[cell]:
                steps[cell] = steps[row, col] + 1
                reached.append(cell)
    return steps


@_jit
def first_step(row: int, col: int, steps: Array, has_apple: Array) -> int:
    """Return the direction of the first step of an agent's way to a cell that it can reach."""
    height, width = steps.shape
    while True:
        for direction in range(4):
            cell = (row - ROW_STEP[direction], col - COL_STEP[direction])
            is_inside = 0 <= cell[0] < height and 0 <= cell[1] < width
            if not is_inside or steps[cell] != steps[row, col] - 1:
                continue
            if steps[cell] == 0:
                return direction
            if not has_apple[cell]:
                row, col = cell
                break


@dataclass(frozen=True, kw_only=True)
class Planner(Value):
    """The numbers that a planner weighs by.

    Raises:
        ValueError: names the field, its value and what is allowed.
    """

    patience_steps: Annotated[float, Range(1, 1e9)] = 160.0
    """The turns for which a change of the growth counts; fewer near the end of an episode."""
    growth_weight_steps: Annotated[float, Range(0, 1e9)] = 20.0
    """The steps that an agent goes further for an apple whose taking adds 1 apple a turn to the growth."""
    haste_steps: Annotated[float, Range(0, 1e9)] = 15.0
    """The turns at the end of an episode in which nothing is left to grow any more."""


CANDIDATES: Final = tuple(Planner(growth_weight_steps=weight) for weight in (0.0, 20.0, 60.0, 200.0))
"""The planners of which `best_planner` takes the best; none is best on all boards."""


def planned_harvest(
    game: Game, planner: Planner | None = None, *, episodes: int = 20, seed: int = SEED
) -> Float64:
    """Return the collective harvest of episodes in which a planner leads all agents, float64 [E], in apples.

    Institutions and what agents observe are left out: what counts is what the board gives.

    Args:
        planner: by default `best_planner(game)`.
        episodes: E; episode e is the first one of world e.
        seed: of the worlds.
    """
    game = replace(game, institutions=())
    lead = _Lead(game, planner or best_planner(game))
    return harvests(CommonsEnv(game, episodes, seed=seed), lead)


@cache
def best_planner(game: Game) -> Planner:
    """Return the candidate that harvests most in 10 episodes, in other worlds than those of
    `planned_harvest`."""

    def harvest(planner: Planner) -> float:
        return float(planned_harvest(game, planner, episodes=10, seed=_SEED_OF_CHOICE).mean())

    return max(CANDIDATES, key=harvest)


class _Lead:
    """A planner that leads the agents of a game of K sites on H x W cells."""

    def __init__(self, game: Game, planner: Planner) -> None:
        self.game = game
        self.planner = planner
        first, near = neighbours(game.map, game.rules)
        self._near = near.astype(np.int64)
        self._site = np.repeat(np.arange(len(first) - 1), np.diff(first))
        """The site near which each of `_near` is."""
        self._cells = tuple(np.array(game.map.sites).T)
        self._is_wall = np.zeros((game.map.height, game.map.width), np.bool_)
        self._is_wall[tuple(np.array(game.map.walls, np.int64).reshape(-1, 2).T)] = True

    def __call__(self, env: CommonsEnv) -> NDArray[np.int64]:
        """Return the actions of all agents, int64 [B, N]."""
        state = env.worlds.state()
        names = ("step", "stock", "row", "col", "heading", "in_play")
        worlds = zip(*(state[name] for name in names), strict=True)
        return np.stack([self._actions(*world) for world in worlds])

    def _actions(
        self, step: Array, stock: Array, row: Array, col: Array, heading: Array, in_play: Array
    ) -> Array:
        """Return the actions of the agents of a world, int64 [N]; those that go nowhere stay."""
        has_apple = stock > 0
        growth = self._growth(has_apple)
        left = self.game.rules.episode_steps - float(step[0]) - self.planner.haste_steps
        is_ripe = has_apple & (growth * max(min(left, self.planner.patience_steps), 1.0) > -1.0)
        apples = self._on_board(has_apple)
        is_closed = self._is_wall | self._on_board(has_apple & ~is_ripe)
        is_closed[row[in_play], col[in_play]] = True
        steps = np.full((len(row), *is_closed.shape), FAR)
        for agent in np.flatnonzero(in_play):
            steps[agent] = ways(row[agent], col[agent], is_closed, apples)
        way = steps[:, *self._cells]
        is_goal = (way < FAR) & np.where(has_apple, is_ripe & (way > 0), True)
        cost = np.where(is_ripe, way - self.planner.growth_weight_steps * growth, FAR + way)
        cost = np.where(is_goal, cost, np.inf)
        actions = np.full(len(row), len(self.game.actions) - 1)  # the last one stays
        while np.isfinite(cost.min()):
            agent, goal = np.unravel_index(cost.argmin(), cost.shape)
            cost[agent] = np.inf
            cost[:, goal] = np.inf
            if is_ripe[goal] or way[agent, goal] > 1:
                goal_row, goal_col = self.game.map.sites[goal]
                direction = first_step(goal_row, goal_col, steps[agent], apples)
                actions[agent] = WALK_TURN.index((direction - heading[agent]) % 4)
        return actions

    def _growth(self, has_apple: Bool) -> Float64:
        """Return by how much the growth of the board rises if the apple on each site is taken, [K]."""
        probs = np.array(self.game.rules.regrow_prob)
        counts = np.bincount(self._site, has_apple[self._near], len(has_apple)).astype(np.int64)
        prob = probs[np.minimum(counts, len(probs) - 1)]
        prob_with_one_less = probs[np.clip(counts - 1, 0, len(probs) - 1)]
        lost = np.where(has_apple, 0.0, prob - prob_with_one_less)
        np.subtract.at(prob, self._site, lost[self._near])
        return prob

    def _on_board(self, is_site: Bool) -> Bool:
        """Return whether each cell is one of these sites, bool [H, W]."""
        board = np.zeros_like(self._is_wall)
        board[self._cells] = is_site
        return board
