"""possible: how many apples an episode of a game could give, from below and from above.

From below by the best policy that is known, a planner or trained agents, from above by proof: nobody gets
more on average than what the board holds at first and the most that it can grow, `yield_bounds`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray
from planner import planned_harvest
from results import LAST, Result, table, with_interval
from yield_bounds import yield_bounds

from cprl import presets
from cprl.commons.game import Game
from cprl.measuring.episodes import yield_of_game
from cprl.measuring.statistics import estimate
from cprl.system.output import say


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
PLANNED: Final[dict[tuple[presets.Board, presets.Variant], Possible]] = {
    ("single_basic", "published"): Possible(best_known=354.0, error=3.4, policy=_PLANNER, at_most=513.0),
    ("single_basic", "as_run"): Possible(best_known=349.2, error=3.1, policy=_PLANNER, at_most=513.0),
    ("single_complex", "published"): Possible(best_known=306.4, error=1.7, policy=_PLANNER, at_most=945.0),
    ("single_complex", "as_run"): Possible(best_known=308.6, error=1.5, policy=_PLANNER, at_most=945.0),
    ("two_complex", "published"): Possible(best_known=409.5, error=34.0, policy=_PLANNER, at_most=945.0),
    ("two_complex", "as_run"): Possible(best_known=458.6, error=30.1, policy=_PLANNER, at_most=945.0),
    ("commons", "published"): Possible(best_known=1390.0, error=14.5, policy=_PLANNER, at_most=2599.0),
    ("commons", "as_run"): Possible(best_known=1395.4, error=7.4, policy=_PLANNER, at_most=2599.0),
}
"""By the name of a board and the variant; `python recipes/study/possible.py` computes them again."""
KNOWN: Final[dict[tuple[presets.Board, presets.Variant], Possible]] = {
    **PLANNED,
    ("single_complex", "as_run"): Possible(
        best_known=364.4, error=2.4, policy="MAPPO on two_complex", at_most=945.0
    ),
}
"""The same, where trained agents get more than the planner by what they get. Of all runs, studies and
comparisons in docs/results that play one of these games unchanged, this is the only one.

`two_complex` has the sites and the regrowth of `single_complex`, a second agent, and a beam. In replica 0 of
MAPPO one agent takes 1.0 apple of an episode and the other 364.4 (50 fresh worlds, "agent_1/return" in
docs/results/learners/two_complex/table.parquet). It begins in another place than the agent of
`single_complex`. The error is that of a mean of 50 episodes which scatter as the 20 of its cross-play did,
with a standard deviation of 17.1 apples (that table left docs/results in commit 24558319)."""


@cache
def possible(game: Game) -> Possible:
    """What a game could give, in its own number of turns; looked up for boards with a name, else played.

    Institutions, beams and what agents observe are left out: what counts is what the board gives.
    """
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


def shares_of(results: Sequence[Result]) -> list[str]:
    """A table of the runs whose games have a board; nothing where none has."""
    rows = [row for result in results for row in _rows(result)]
    if not rows:
        return []
    head = ["run", "harvest, apples", "best known", "share of it", "bound", "share of it", "yield share"]
    return [
        "## Share of the possible",
        "",
        f"Harvests are means over the last {LAST} episodes of training, or all of a shorter one, over "
        "replicas with t intervals. The best known policy is a planner that sees all and harvests for the "
        "group (`recipes/study/planner.py`), trained agents if any get more (`recipes/study/possible.py`), "
        "or the run itself if it does. No policy gets more on "
        "average than the bound: what the board holds at first, and the most that it can grow "
        "(`yield_bounds`). The yield share (docs/metrics.md) counts in what the board can "
        "bear for ever in the steps that were played, so that it is high, too, for agents who take all at "
        "once, and end the episode. Shares are of means, but for the yield share, a mean over episodes.",
        "",
        *table(head, rows),
    ]


def _rows(result: Result) -> Iterator[list[str]]:
    game = result.experiment.game
    if not isinstance(game, Game):
        return
    could = possible(game)
    harvests, steps = (result.curves[name][:, -LAST:] for name in ("collective_return", "survival_steps"))
    board = yield_of_game(game)
    bearable = board["sustainable_yield"] * steps + board["first_stock"]
    own = harvests.mean(1)
    best, who = max((could.best_known, could.policy), (float(own.mean()), "this run"))
    yield [
        result.name,
        with_interval(own),
        f"{best:.0f} ({who})",
        _share(own, best, who),
        f"{could.at_most:.0f}",
        f"{own.mean() / could.at_most:.0%}",
        with_interval(np.asarray((harvests / bearable).mean(1))),
    ]


def _share(own: NDArray[np.float64], best: float, who: str) -> str:
    """The share of the best known with its interval, [R] replicas; of a run that is the best itself none."""
    if not best:
        return ""
    return f"{own.mean() / best:.0%}" if who == "this run" else f"{estimate(own / best):.0%}"


if __name__ == "__main__":  # the rows of PLANNED again, in some minutes of a core
    for board in presets.BOARDS:
        for variant in ("published", "as_run"):
            found = computed(presets.game(board, variant=variant))
            say(
                f'    ("{board}", "{variant}"): Possible(best_known={found.best_known:.1f}, '
                f"error={found.error:.1f}, policy=_PLANNER, at_most={found.at_most:.1f}),"
            )
