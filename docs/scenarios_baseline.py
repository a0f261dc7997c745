"""The committed populations in all scenarios of their games: estimates, figures and tables.

    nice -n 10 python docs/scenarios_baseline.py
    python docs/scenarios_baseline.py --tables

The first one writes NAME.csv and NAME.png for each population into docs/results/scenarios, and leaves out
those whose NAME.csv is there, so that it can be stopped and started again. The second one plays nothing and
prints the tables. Of the figures only commons.png is on a page, so the others are not committed.
"""

import csv
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import pyarrow.csv
import tyro
from scipy import stats

import cprl
from cprl.evaluation import draw_scenarios, run_scenarios, scenario_advantages
from cprl.measuring.statistics import CONFIDENCE, holm
from cprl.measuring.table import all_metrics
from cprl.runs.files import write_atomically
from cprl.system.process import prepare_process

DOCS: Final = Path(__file__).parent
OUT: Final = DOCS / "results" / "scenarios"
POPULATIONS: Final = ("two_complex", "commons", "commons_published", "two_complex_no_beam")
"""Folders of docs/results with weights, one for each game that has a stored background."""
EPISODES: Final = 4
"""The episodes of each replica in each placement."""
SEED: Final = 30_011
"""No training of ours uses it."""

COLUMNS: Final = {
    "return per focal agent": ("run", "focal/return"),
    "greedy in their place": ("greedy", "focal/return"),
    "random in their place": ("random", "focal/return"),
    "more than greedy": ("greedy", "focal/advantage"),
    "return per background agent": ("run", "background/return"),
    "more than beside greedy": ("greedy", "background/advantage"),
    "collective return": ("run", "collective_return"),
    "equality": ("run", "equality"),
    "survival, steps": ("run", "survival_steps"),
}
"""Columns of the page by who is focal and the metric."""


def play(name: str, *, episodes: int) -> None:
    """Play a population's scenarios, and write the estimates and the figure."""
    played = run_scenarios(DOCS / "results" / name, cprl.Fresh(episodes=episodes, seed=SEED))
    OUT.mkdir(exist_ok=True)
    draw_scenarios(played, OUT / f"{name}.png")
    found = estimates_of(played)
    write_atomically(OUT / f"{name}.csv", lambda file: pyarrow.csv.write_csv(found, file))


def estimates_of(played: pa.Table) -> pa.Table:
    """Return every number of every scenario as a row.

    Its columns are "scenario", "focal" (the agents in the focal places), "metric", "value", "low" and "high",
    and how many "replicas", "episodes" and "undefined" episodes there were.
    Metrics "focal/advantage" and "background/advantage" of "random" and "greedy" are what the run's agents,
    or the background among them, get more.
    """
    returns = ("focal/return", "background/return")
    levels = cprl.estimates(played, [*returns, *all_metrics(played)], by=("scenario", "focal")).table()
    more = scenario_advantages(played).table()
    renamed = [name.replace("return", "advantage") for name in more["number"].to_pylist()]
    more = more.set_column(more.column_names.index("number"), "number", pa.array(renamed))
    found = pa.concat_tables([levels, more], promote_options="default").select(
        ["scenario", "focal", "number", "value", "low", "high", "replicas", "episodes", "undefined"]
    )
    return found.rename_columns({"number": "metric"})


def table(name: str) -> str:
    """Return the Markdown table of a population; bold is what is not 0 by Holm's method for all of it."""
    with (OUT / f"{name}.csv").open() as file:
        rows = list(csv.DictReader(file))
    found = {(row["scenario"], row["focal"], row["metric"]): row for row in rows}
    scenarios = list(dict.fromkeys(row["scenario"] for row in rows))
    compared = [(scenario, *at) for scenario in scenarios for at in COLUMNS.values() if is_difference(*at)]
    apart = dict(zip(compared, holm([p_value(found[at]) for at in compared]), strict=True))
    lines = ["| " + " | ".join(["scenario", *COLUMNS]) + " |", "|---|" + "---:|" * len(COLUMNS)]
    for scenario in scenarios:
        cells = [shown(found[scenario, *at], signed=is_difference(*at)) for at in COLUMNS.values()]
        bold = [apart.get((scenario, *at), False) for at in COLUMNS.values()]
        cells = [f"**{cell}**" if is_bold else cell for cell, is_bold in zip(cells, bold, strict=True)]
        lines.append("| " + " | ".join([f"`{scenario}`", *cells]) + " |")
    return "\n".join(lines)


def is_difference(_: str, metric: str) -> bool:
    return metric.endswith("advantage")


def p_value(row: dict[str, Any]) -> float:
    """Return the p-value of a difference of 0, from its interval by Student's t."""
    freedom = int(row["replicas"]) - 1
    error = (float(row["high"]) - float(row["low"])) / 2 / stats.t.ppf((1 + CONFIDENCE) / 2, freedom)
    return float(2 * stats.t.sf(abs(float(row["value"])) / error, freedom))


def shown(row: dict[str, Any], *, signed: bool) -> str:
    """Return an estimate with its interval."""
    if not row["value"]:
        return "undefined"
    value, low, high = (float(row[bound]) for bound in ("value", "low", "high"))
    digits = 2 if max(abs(value), abs(low), abs(high)) < 2 else 0
    sign = "+" if signed else ""
    return f"{value:{sign}.{digits}f} [{low:{sign}.{digits}f}, {high:{sign}.{digits}f}]"


def main(*, tables: bool = False, episodes: int = EPISODES) -> None:
    """Play the scenarios, or print their tables.

    Args:
        tables: print the tables of what has been played, and play nothing.
        episodes: of each replica in each placement.
    """
    prepare_process(SEED)
    for name in POPULATIONS:
        is_there = (OUT / f"{name}.csv").exists()
        if tables and is_there:
            print(f"### {name}\n\n{table(name)}\n")
        elif not tables and not is_there:
            play(name, episodes=episodes)
            print(f"{name}: done", flush=True)


if __name__ == "__main__":
    tyro.cli(main)
