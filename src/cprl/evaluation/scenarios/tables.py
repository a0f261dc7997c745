"""Scores of scenarios as tables for the terminal, and as a table of estimates."""

from collections.abc import Iterator
from math import isnan
from typing import Any, Final

import pyarrow as pa
from rich.table import Table

from cprl.arguments import object_of
from cprl.evaluation.scenarios.score import FOCAL_AGENTS, Scores
from cprl.evaluation.tables import how_they_play
from cprl.measuring.names import with_unit
from cprl.measuring.statistics import Estimate

SOCIAL: Final = ("collective_return", "equality", "sustainability", "survival_steps", "peacefulness")
"""The social metrics of the table in the terminal; the others are in `estimates`."""

_SCHEMA: Final = pa.schema(
    [
        ("scenario", pa.string()),
        ("focal", pa.string()),
        ("metric", pa.string()),
        ("value", pa.float64()),
        ("low", pa.float64()),
        ("high", pa.float64()),
        ("replicas", pa.int32()),
        ("episodes", pa.int32()),
        ("undefined", pa.int32()),
    ]
)


def heading(scores: Scores) -> str:
    """The heading of the tables."""
    how = how_they_play([scores.run], scores.greedy)
    return (
        f"Scenarios of {scores.run.path.name}: {len(scores.replicas)} replicas, {scores.episodes} episodes "
        f"each in each placement, seed {scores.seed}{how}\nmean over replicas [95 % interval by Student's t]"
    )


def scenario_tables(scores: Scores) -> Iterator[Table]:
    """A table of returns, a row for each scenario, and one of social metrics of all agents together."""
    yield _returns_table(scores)
    yield _social_table(scores)


def _returns_table(scores: Scores) -> Table:
    table = Table(title="return per agent (apples)", title_justify="left")
    table.add_column("scenario")
    for name in (
        *("focal: the run's agents", "random in their place", "greedy in their place"),
        *("run's - random's, paired", "run's - greedy's, paired", "background"),
    ):
        table.add_column(name, justify="right")
    for name, score in scores.by_scenario.items():
        focal = [str(score.measures(who)["focal/return"]) for who in FOCAL_AGENTS]
        ahead = [str(score.advantage(who)) for who in ("random", "greedy")]
        table.add_row(name, *focal, *ahead, str(score.measures()["background/return"]))
    table.caption = f"Left out: {scores.left_out}." if scores.left_out else None
    return table


def _social_table(scores: Scores) -> Table:
    table = Table(
        title="all agents together, with the run's agents in the focal places", title_justify="left"
    )
    table.add_column("scenario")
    for name in SOCIAL:
        table.add_column(with_unit(name), justify="right")
    for name, score in scores.by_scenario.items():
        measures = score.measures()
        table.add_row(name, *(str(measures[metric]) for metric in SOCIAL))
    return table


def estimates(scores: Scores) -> pa.Table:
    """Every measure of every scenario as a row: "scenario", "focal" (who takes the focal places), "metric",
    "value", "low" and "high" (null where undefined), and how many "replicas", "episodes" and "undefined"
    episodes there were. Metrics "focal/advantage" and "background/advantage" of "random" and "greedy" are
    what the run's agents, or the background among them, get more; see `Score.advantage`.

    Raises:
        ValueError: if `scores` is not what `run_scenarios` gave.
    """
    object_of("scores", scores, Scores, "what run_scenarios() gave")
    rows: list[dict[str, Any]] = []
    for name, score in scores.by_scenario.items():
        for who in FOCAL_AGENTS:
            for metric, measured in score.measures(who).items():
                rows.append(
                    {"scenario": name, "focal": who, "metric": metric}
                    | _numbers(measured.estimate)
                    | {"episodes": measured.episodes, "undefined": measured.undefined}
                )
            if who == "run":
                continue
            for whose in ("focal", "background"):
                rows.append(
                    {"scenario": name, "focal": who, "metric": f"{whose}/advantage"}
                    | _numbers(score.advantage(who, whose=whose))
                    | {"episodes": rows[-1]["episodes"], "undefined": 0}
                )
    return pa.Table.from_pylist(rows, schema=_SCHEMA)


def _numbers(found: Estimate | None) -> dict[str, Any]:
    if found is None:
        return {"value": None, "low": None, "high": None, "replicas": 0}
    low, high = (None if isnan(bound) else bound for bound in (found.low, found.high))
    return {"value": found.value, "low": low, "high": high, "replicas": found.replicas}
