"""What share of the possible runs got: beside the best policy that is known, and beside a proven bound."""

from collections.abc import Iterator, Sequence

import numpy as np

from cprl.commons.game import Game
from cprl.measuring.possible import possible
from cprl.measuring.yields import yield_of_game
from cprl.reporting.claims import with_interval
from cprl.reporting.claims_alone import LAST
from cprl.reporting.markdown import table
from cprl.reporting.result import Result


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
        "group (`cprl.theory.planned_harvest`), or the run itself if it gets more. No policy gets more on "
        "average than the bound: what the board holds at first, and the most that it can grow "
        "(`cprl.theory.yield_bounds`). The yield share (docs/metrics.md) counts in what the board can "
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
        f"{own.mean() / best:.0%}" if best else "",
        f"{could.at_most:.0f}",
        f"{own.mean() / could.at_most:.0%}",
        with_interval(np.asarray((harvests / bearable).mean(1))),
    ]
