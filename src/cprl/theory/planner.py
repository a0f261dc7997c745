"""planned_harvest: what a planner that sees all and harvests for the group gets, a lower bound of the best.

An apple is worth 1 now; taking it changes how fast the board grows, for as long as the planner looks ahead.
It is ripe if that costs less than it is worth. Agents are sent to ripe apples one after the other, the one
with the shortest way first, around apples that are to stay; the others wait beside empty sites. Nobody fires.
Near the end of the episode less and less growth is worth keeping.

It is a rule of thumb, not an optimum: nobody has shown that more cannot be got; what certainly cannot, see
`cprl.theory.yield_bounds`.
"""

from dataclasses import dataclass, replace
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cprl import arguments
from cprl.checks import Check, check_fields, is_number
from cprl.commons.batch import Batch
from cprl.commons.game import Game
from cprl.commons.near import neighbours
from cprl.commons.playing import harvests
from cprl.theory.planner_rules import Agents, Board, Desk, Plan, decide

SEED: Final = 50_021
"""Of the worlds in which harvests are measured; no training of ours uses it."""
_SEED_OF_CHOICE: Final = 50_023
"""Of those in which the best candidate is chosen."""

Values = NDArray[np.float64]

_CHECKS: Final[dict[str, Check]] = {
    "patience_steps": Check(lambda value: is_number(value, 1, 1e9), "a number of at least 1"),
    **dict.fromkeys(
        ("growth_weight_steps", "haste_steps"),
        Check(lambda value: is_number(value, 0, 1e9), "a number of at least 0"),
    ),
}


@dataclass(frozen=True, kw_only=True)
class Planner:
    """The numbers that a planner weighs by.

    Raises:
        ValueError: names the field, what came and what is allowed.
    """

    patience_steps: float = 160.0
    """For how many turns a change of the growth counts, at least 1; fewer near the end of an episode."""
    growth_weight_steps: float = 20.0
    """How many steps further an agent goes for an apple whose taking adds 1 apple a turn to the growth."""
    haste_steps: float = 15.0
    """How many turns before the end of an episode nothing is left to grow any more."""

    def __post_init__(self) -> None:
        check_fields(self, _CHECKS)


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

    Raises:
        ValueError: for anything else.
    """
    arguments.object_of("game", game, Game, "a cprl.Game")
    arguments.object_of("planner", planner, Planner | None, "a Planner, or None for the best one")
    episodes = arguments.integer("episodes", episodes, 1, 2**20)
    game = replace(game, institutions=())
    lead = _Lead(game, planner or best_planner(game))
    return harvests(Batch(game, episodes, seed=arguments.seed(seed)), lead)


def best_planner(game: Game) -> Planner:
    """The candidate that harvests most in 10 episodes, in other worlds than those of `planned_harvest`.

    Raises:
        ValueError: for what `planned_harvest` refuses.
    """
    arguments.object_of("game", game, Game, "a cprl.Game")
    return _best_planner(game)


@cache
def _best_planner(game: Game) -> Planner:
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

    def __call__(self, batch: Batch) -> NDArray[np.int64]:
        """The actions of all agents, int64 [B, N]."""
        state = batch.state()
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
