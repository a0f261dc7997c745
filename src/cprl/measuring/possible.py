"""possible: how many apples an episode of a game could give, from below and from above.

From below by the best policy that is known, from above by proof: nobody gets more on average than what the
board holds at first and the most that it can grow, `cprl.theory.yield_bounds`.
"""

from dataclasses import dataclass, replace
from functools import cache
from typing import Final

from cprl import presets
from cprl.arguments import object_of
from cprl.commons.game import Game
from cprl.theory.growth import yield_bounds
from cprl.theory.planner import planned_harvest


@dataclass(frozen=True, kw_only=True)
class Possible:
    """What all agents together can harvest in an episode, in apples."""

    best_known: float
    """The mean of the best policy that is known, over episodes."""
    error: float
    """Its standard error."""
    policy: str
    """Which one that is."""
    at_most: float
    """What no policy exceeds on average."""


_PLANNER: Final = "planner"
KNOWN: Final[dict[tuple[presets.Board, presets.Variant], Possible]] = {
    ("single_basic", "published"): Possible(best_known=354.0, error=3.4, policy=_PLANNER, at_most=513.0),
    ("single_basic", "as_run"): Possible(best_known=349.2, error=3.1, policy=_PLANNER, at_most=513.0),
    ("single_complex", "published"): Possible(best_known=306.4, error=1.7, policy=_PLANNER, at_most=945.0),
    ("single_complex", "as_run"): Possible(best_known=308.6, error=1.5, policy=_PLANNER, at_most=945.0),
    ("two_complex", "published"): Possible(best_known=409.5, error=34.0, policy=_PLANNER, at_most=945.0),
    ("two_complex", "as_run"): Possible(best_known=458.6, error=30.1, policy=_PLANNER, at_most=945.0),
    ("commons", "published"): Possible(best_known=1390.0, error=14.5, policy=_PLANNER, at_most=2599.0),
    ("commons", "as_run"): Possible(best_known=1395.4, error=7.4, policy=_PLANNER, at_most=2599.0),
}
"""By the name of a board and the variant; `python docs/best_known.py` computes them again."""


@cache
def possible(game: Game) -> Possible:
    """What a game could give, in its own number of turns; looked up for boards with a name, else played.

    Institutions, beams and what agents observe are left out: what counts is what the board gives.

    Args:
        game: the game.

    Raises:
        ValueError: for anything else.
    """
    object_of("game", game, Game, "a cprl.Game")
    for (board, variant), known in KNOWN.items():
        named = presets.game(board, variant=variant)
        if game.map == named.map and _grows_as(game, named):
            return known
    return computed(game)


def _grows_as(game: Game, other: Game) -> bool:
    """Whether the rules differ in nothing but whether agents may fire."""
    return replace(game.rules, may_fire=other.rules.may_fire) == other.rules


def computed(game: Game) -> Possible:
    """`possible`, by playing 20 episodes under the planner's lead and searching for the bound."""
    harvests = planned_harvest(game)
    bounds = yield_bounds(game.map, game.rules)
    return Possible(
        best_known=float(harvests.mean()),
        error=float(harvests.std(ddof=1) / len(harvests) ** 0.5),
        policy=_PLANNER,
        at_most=len(game.map.sites) + bounds.at_most * game.rules.episode_steps,
    )
