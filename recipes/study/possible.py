"""How many apples could an episode give, and what share of them do runs get? Bounds from below and above.

The bound from below is the best policy that is known, a planner or trained agents; that from above is proven:
nobody gets more on average than what the board holds at first and the most that it can grow, `yield_bounds`.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Final, NamedTuple

from measures import with_interval
from page import section
from planner import planned_harvest
from results import LAST, Result
from yield_bounds import yield_bounds

from cprl import presets
from cprl.commons.game import Game
from cprl.measuring.registry import constants_of
from cprl.measuring.statistics import estimate
from cprl.system.output import say


class Possible(NamedTuple):
    """The apples that all agents together can harvest in an episode."""

    best_known: float
    """The mean of the best policy that is known, over episodes."""
    error: float
    """Its standard error."""
    at_most: float
    """The apples that no policy exceeds on average."""
    policy: str = "planner"
    """The best policy that is known."""


PLANNED: Final[dict[tuple[presets.Board, presets.Variant], Possible]] = {
    ("single_basic", "published"): Possible(354.0, 3.4, 513.0),
    ("single_basic", "as_run"): Possible(349.2, 3.1, 513.0),
    ("single_complex", "published"): Possible(306.4, 1.7, 945.0),
    ("single_complex", "as_run"): Possible(308.6, 1.5, 945.0),
    ("two_complex", "published"): Possible(409.5, 34.0, 945.0),
    ("two_complex", "as_run"): Possible(458.6, 30.1, 945.0),
    ("commons", "published"): Possible(1390.0, 14.5, 2599.0),
    ("commons", "as_run"): Possible(1395.4, 7.4, 2599.0),
}
"""The harvests of a planner, by the name of a board and the variant; `python recipes/study/possible.py`
computes them again."""
_TRAINED: Final = Possible(364.4, 2.4, 945.0, "MAPPO on two_complex")
KNOWN: Final = {**PLANNED, ("single_complex", "as_run"): _TRAINED}
"""The same, where trained agents get more than the planner by what they get. Of all runs, studies and
comparisons in docs/results that play one of these games unchanged, this is the only one.

`two_complex` has the sites and the regrowth of `single_complex`, a second agent, and a beam. In replica 0 of
MAPPO one agent takes 1.0 apple of an episode and the other 364.4 (50 fresh worlds, "agent_1/return" in
docs/results/learners/two_complex/table.parquet). It begins in another place than the agent of
`single_complex`. The error is that of a mean of 50 episodes which scatter as the 20 of its cross-play did,
with a standard deviation of 17.1 apples (that table left docs/results in commit 24558319)."""


@cache
def possible(game: Game) -> Possible:
    """Return what a game could give, in its own number of turns; looked up for boards with a name, else
    played.

    Institutions, beams and what agents observe are left out: what counts is what the board gives.
    """
    for (board, variant), known in KNOWN.items():
        preset = presets.game(board, variant=variant)
        may_fire = preset.rules.may_fire
        if game.map == preset.map and replace(game.rules, may_fire=may_fire) == preset.rules:
            return known
    return computed(game)


def computed(game: Game) -> Possible:
    """Return `possible`, by playing 20 episodes under the planner's lead and searching for the bound."""
    harvests = planned_harvest(game)
    bounds = yield_bounds(game.map, game.rules)
    return Possible(
        best_known=float(harvests.mean()),
        error=float(harvests.std(ddof=1) / len(harvests) ** 0.5),
        at_most=len(game.map.sites) + bounds.at_most * game.rules.episode_steps,
    )


def sections(results: Sequence[Result]) -> list[str]:
    """Return the section on the runs whose games have a board; nothing where none has."""
    head = ["run", "harvest, apples", "best known", "share of it", "bound", "share of it", "yield share"]
    note = (
        f"Harvests are means over the last {LAST} episodes of training, or all of a shorter one, over "
        "replicas with t intervals. The best known policy is a planner that sees all and harvests for the "
        "group (`recipes/study/planner.py`), trained agents if any get more (`recipes/study/possible.py`), "
        "or the run itself if it does. No policy gets more on "
        "average than the bound: what the board holds at first, and the most that it can grow "
        "(`yield_bounds`). The yield share (docs/metrics.md) counts in what the board can "
        "bear for ever in the steps that were played, so that it is high, too, for agents who take all at "
        "once, and end the episode. Shares are of means, but for the yield share, a mean over episodes."
    )
    rows = [_cells(result) for result in results if isinstance(result.experiment.game, Game)]
    return section("Share of the possible", head, rows, note)


def _cells(result: Result) -> list[str]:
    game = result.experiment.game
    bounds = possible(game)
    board = constants_of(game)
    harvests = result.at_end("collective_return")
    bearable = board["sustainable_yield"] * result.curves["survival_steps"] + board["first_stock"]
    yield_shares = (result.curves["collective_return"] / bearable)[:, -LAST:]
    best = bounds.best_known
    policy = bounds.policy
    share = f"{estimate(harvests / best):.0%}" if best else ""
    if harvests.mean() > best:
        best = harvests.mean()
        policy = "this run"
        share = "100%"
    return [
        result.name,
        with_interval(harvests),
        f"{best:.0f} ({policy})",
        share,
        f"{bounds.at_most:.0f}",
        f"{harvests.mean() / bounds.at_most:.0%}",
        with_interval(yield_shares.mean(1)),
    ]


if __name__ == "__main__":  # the rows of PLANNED again, in some minutes of a core
    for board in presets.BOARDS:
        for variant in ("published", "as_run"):
            bounds = computed(presets.game(board, variant=variant))
            numbers = f"{bounds.best_known:.1f}, {bounds.error:.1f}, {bounds.at_most:.1f}"
            say(f'    ("{board}", "{variant}"): Possible({numbers}),')
