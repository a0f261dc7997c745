"""The committed populations in all scenarios of their games: estimates, figures, and tables for scenarios.md.

    nice -n 10 python docs/scenarios_baseline.py
    python docs/scenarios_baseline.py --tables

The first one writes NAME.csv and NAME.png for each population into docs/results/scenarios, and leaves out
those whose NAME.csv is there, so that it can be stopped and started again. The second one plays nothing and
prints the tables of the page.
"""

import csv
from pathlib import Path
from typing import Any, Final

import pyarrow.csv
import tyro

from cprl.evaluation import draw_scenarios, run_scenarios
from cprl.evaluation.scenarios import estimates
from cprl.runs.files import write_atomically
from cprl.system.process import prepare_process

DOCS: Final = Path(__file__).parent
OUT: Final = DOCS / "results" / "scenarios"
POPULATIONS: Final = ("two_complex", "commons", "commons_published", "two_complex_no_beam")
"""Folders of docs/results with weights, one for each game that has a stored background."""
EPISODES: Final = 4
"""Of each replica in each placement."""
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
    """Plays a population's scenarios, and writes the estimates and the figure."""
    scores = run_scenarios(DOCS / "results" / name, episodes=episodes, seed=SEED)
    OUT.mkdir(exist_ok=True)
    draw_scenarios(scores, OUT / f"{name}.png")
    found = estimates(scores)
    write_atomically(OUT / f"{name}.csv", lambda file: pyarrow.csv.write_csv(found, file))


def table(name: str) -> str:
    """The Markdown table of a population."""
    with (OUT / f"{name}.csv").open() as file:
        rows = list(csv.DictReader(file))
    found = {(row["scenario"], row["focal"], row["metric"]): row for row in rows}
    lines = ["| " + " | ".join(["scenario", *COLUMNS]) + " |", "|---|" + "---:|" * len(COLUMNS)]
    for scenario in dict.fromkeys(row["scenario"] for row in rows):
        cells = [shown(found[scenario, *at], signed=at[1].endswith("advantage")) for at in COLUMNS.values()]
        lines.append("| " + " | ".join([f"`{scenario}`", *cells]) + " |")
    return "\n".join(lines)


def shown(row: dict[str, Any], *, signed: bool) -> str:
    """An estimate with its interval; bold where the interval of a difference excludes 0."""
    if not row["value"]:
        return "undefined"
    value, low, high = (float(row[bound]) for bound in ("value", "low", "high"))
    digits = 2 if max(abs(value), abs(low), abs(high)) < 2 else 0
    sign = "+" if signed else ""
    text = f"{value:{sign}.{digits}f} [{low:{sign}.{digits}f}, {high:{sign}.{digits}f}]"
    return f"**{text}**" if signed and not low <= 0 <= high else text


def main(*, tables: bool = False, episodes: int = EPISODES) -> None:
    """Plays the scenarios, or prints their tables.

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
