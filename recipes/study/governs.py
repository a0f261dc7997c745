"""What governs the commons? One figure and one table of every factor that the committed studies vary.

    python recipes/study/governs.py

To be run in the root of the repository: reads tables in docs/results, and writes into docs/results/governs
table.md, governs.png, and elsewhere.md, six of the changes in the settings of elsewhere.py. In the conditions
of table.md four DQN agents play `commons` as run, 200 episodes on the short schedule of base.py, with one
thing changed; numbers are means of the last 30 episodes of each replica, then over replicas.
"""

from functools import cache
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import tyro
from effects import marked
from numpy.typing import NDArray
from possible import KNOWN

from cprl.commons.colours import BLUE, GREEN, GREY, ORANGE, PURPLE, VERMILION
from cprl.measuring.statistics import Estimate, difference, estimate
from cprl.runs.curves import curves_of, net_of
from cprl.studies import StudyTable
from cprl.studies.tables.comparing import compare
from cprl.terminal import style
from cprl.terminal.style import RANDOM_LINE

RESULTS: Final = Path("docs", "results")
LAST: Final = 30
"""Episodes at the end of each replica."""
BEST: Final = KNOWN["commons", "as_run"].best_known
"""Apples of the best known policy, the planner, on the unchanged game."""

GROUPS: Final = {
    "none": (GREY, "nothing changed"),
    "resource": (GREEN, "resource"),
    "people": (PURPLE, "people"),
    "minds": (BLUE, "minds"),
    "weapons": (VERMILION, "weapons"),
    "institutions": (ORANGE, "institutions"),
}
"""The colour and the name of each group of factors."""

SPACE: Final = (
    *("half the apples, scattered", "as many apples, scattered", "twice the apples, scattered"),
    *("as many apples, in patches", "half the board", "twice the board", "four times the board"),
    *("quarters, open", "quarters, walls with a door", "quarters, walls"),
)
"""Conditions of recipes/study/space.py, which are their names here."""

STUDIES: Final = {
    "resource": [
        *(("regrowth", f"regrowth={k}", f"regrowth x {k}") for k in ("0.25", "0.5", "2", "4")),
        *(("space", condition, condition) for condition in SPACE),
    ],
    "people": [("agents", f"{n}, same board", f"{n} agents") for n in (2, 8, 12)],
    "minds": [
        *(("discount", f"gamma={gamma}", f"discount {gamma}") for gamma in ("0", "0.8", "0.99", "0.995")),
        *(
            ("network_width", f"hidden_cells=({n}, {n})", f"networks of {n} units a layer")
            for n in (2, 8, 128)
        ),
        ("networks", "GRU of 32", "memory (GRU)"),
        ("networks", "convolutions", "convolutions"),
        *(("view", f"view={size}", f"sight {size}") for size in ("3 x 7", "11 x 23", "full board")),
    ],
    "weapons": [
        ("beam", "no beam", "no beam"),
        ("beam", "one hit tags", "one hit tags"),
        *(("time_out", f"freeze_steps={n}", f"time-out {n}") for n in (1, 5, 100, 400)),
        ("beam_size", "beam_length_cells=2, beam_width_cells=1", "beam 2 x 1"),
        ("beam_size", "beam_length_cells=12, beam_width_cells=5", "beam 12 x 5"),
    ],
    "institutions": [
        ("rules", "automatic penalty", "penalty that is certain (5)"),
        ("rules", "fines for regions", "fines for regions (1)"),
        ("rules", "one may punish, harshly", "one agent may punish (5)"),
        ("talk", "talk", "cheap talk"),
        ("talk", "quota", "quota that may be broken (2)"),
        ("talk", "quota, talk", "the same quota, and talk"),
    ],
}
"""By group: the study, its condition, and the name here."""

INSTITUTIONS: Final = {
    "boundaries": "boundaries (1)",
    "quota": "quota (2)",
    "vote": "vote on a tax (3)",
    "monitoring": "monitored quota (4)",
    "graduated_sanctions": "graduated sanctions (5)",
    "mediation": "mediation (6)",
    "sanctioner": "elected sanctioner (7)",
    "levies": "nested levies (8)",
}
"""By the directory of the run: the name, with the number of Ostrom's principle."""

AS_HERE: Final = {
    "twice the apples": ("space", "twice the apples, scattered", "commons"),
    "regrowth x 2": ("regrowth", "regrowth=2", "regrowth=1"),
    "half the agents": ("agents", "2, same board", "4"),
    "networks of 2 units": ("network_width", "hidden_cells=(2, 2)", "hidden_cells=(32, 32)"),
    "quota": ("institutions", "quota", "none"),
    "penalty that is certain": ("rules", "automatic penalty", "none"),
}
"""The changes of recipes/study/elsewhere.py: where they are on the short schedule, and what beside."""

RANDOM, RESTRAINT = 282.0, 926.0
"""Apples an episode of random play (docs/institutions.md) and of the scripted "sustainable" agents
(docs/results/schelling/table.md), on the unchanged game."""


class Row(NamedTuple):
    """A condition and its measurements over replicas."""

    group: str
    name: str
    replicas: int
    net: Estimate
    """Apples after fines, all agents together."""
    survival: Estimate
    """Turns."""
    equality: Estimate


@cache
def table_of(study: str) -> StudyTable:
    """The committed table of a study."""
    return StudyTable.read(RESULTS / "studies" / study / "table.parquet")


def nets(study: str, condition: str) -> NDArray[np.float64]:
    """The harvest after fines of each replica, in apples."""
    if study == "institutions":
        return np.nanmean(net_of(curves_of(RESULTS / study / condition))[:, -LAST:], 1)
    table = table_of(study)
    net = "net" if "net" in table.metrics else "collective_return"  # without fines the same
    return compare(table, net, last=LAST).by_name[condition].defined


def of_study(group: str, study: str, condition: str, name: str) -> Row:
    """A condition of a study."""
    others = ("survival_steps", "equality")
    measured = (compare(table_of(study), metric, last=LAST).by_name[condition].defined for metric in others)
    return row(group, name, nets(study, condition), *measured)


def of_run(group: str, folder: str, name: str) -> Row:
    """A run of recipes/institutions.py."""
    curves = curves_of(RESULTS / "institutions" / folder)
    measured = (np.nanmean(curves[metric][:, -LAST:], 1) for metric in ("survival_steps", "equality"))
    return row(group, name, nets("institutions", folder), *measured)


def row(group: str, name: str, *measured: NDArray[np.float64]) -> Row:
    return Row(group, name, len(measured[0]), *map(estimate, measured))


def rows() -> list[Row]:
    """All conditions, group by group, in each the largest harvest first."""
    found = [of_run("none", "none", "nothing changed")]
    for group, conditions in STUDIES.items():
        found += [of_study(group, *condition) for condition in conditions]
    found += [of_run("institutions", folder, name) for folder, name in INSTITUTIONS.items()]
    order = list(GROUPS)
    return sorted(found, key=lambda one: (order.index(one.group), -one.net.value))


def text_of(found: Estimate, most: float = np.inf) -> str:
    """A mean with its interval, which ends at the most that is possible."""
    digits = 2 if found.high < 5 else 0
    value, low, high = (f"{min(number, most):,.{digits}f}" for number in (found.value, found.low, found.high))
    return f"{value} [{low}, {high}]"


def table(found: list[Row]) -> str:
    """The table in Markdown."""
    lines = [
        "| changed | group | replicas | apples after fines | share of best | survival, turns | equality |",
        "|---|---|---:|---:|---:|---:|---:|",
    ]
    for one in found:
        share = f"{one.net.value / BEST:.0%}"
        cells = text_of(one.net), share, text_of(one.survival, most=1000), text_of(one.equality, most=1)
        numbers = " | ".join(cells)
        lines.append(f"| {one.name} | {GROUPS[one.group][1]} | {one.replicas} | {numbers} |")
    return "\n".join([*lines, ""])


def elsewhere() -> str:
    """A table in Markdown of what each change adds, and how many times the harvest it gives, by setting."""
    columns = {"DQN, 1 world": [(nets(of, name), nets(of, base)) for of, name, base in AS_HERE.values()]}
    conditions = table_of("elsewhere").design.conditions
    for setting in dict.fromkeys(name.partition(": ")[0] for name in conditions):
        base = nets("elsewhere", f"{setting}: nothing changed")
        columns[setting] = [(nets("elsewhere", f"{setting}: {change}"), base) for change in AS_HERE]
    lines = [f"| apples after fines | {' | '.join(columns)} |", "|---|" + "---:|" * len(columns)]
    unchanged = " | ".join(text_of(estimate(pairs[0][1])) for pairs in columns.values())
    cells = [changes(pairs) for pairs in columns.values()]
    lines.append(f"| nothing changed | {unchanged} |")
    for change, *texts in zip(AS_HERE, *cells, strict=True):
        lines.append(f"| {change} | {' | '.join(texts)} |")
    return "\n".join([*lines, ""])


def changes(pairs: list[tuple[NDArray[np.float64], NDArray[np.float64]]]) -> list[str]:
    """The difference of each, paired by replica, and the ratio; stars by Holm's method for all of these."""
    texts = marked([difference(*pair, paired=True) for pair in pairs])
    ratios = [value.mean() / base.mean() for value, base in pairs]
    return [f"{text}, x {ratio:.1f}" for text, ratio in zip(texts, ratios, strict=True)]


def draw(found: list[Row], path: Path) -> None:
    """Draw harvest, survival and equality of each condition."""
    panels_of = {"net": "harvest after fines, % of best", "survival": "survival, turns"}
    panels_of |= {"equality": "equality"}
    with style.drawing(path) as sheet:
        panels = sheet.panels(3, columns=3, high=1.5 * len(found) + 4, sharey=True)
        for axes, (metric, title) in zip(panels, panels_of.items(), strict=True):
            scale = 100 / BEST if metric == "net" else 1
            named: set[str] = set()
            for place, one in enumerate(found):
                colour, group = GROUPS[one.group]
                measured = getattr(one, metric)
                shade = np.array(colour) / 255
                ends = [scale * measured.low, scale * measured.high]
                axes.plot(ends, [place, place], color=shade, linewidth=2)
                label = group if axes is panels[0] and group not in named else None
                axes.plot([scale * measured.value], [place], "o", color=shade, markersize=5, label=label)
                named.add(group)
            axes.set_title(title)
            axes.grid(axis="x", alpha=0.3)
            groups = [one.group for one in found]
            for place in range(1, len(found)):
                if groups[place] != groups[place - 1]:
                    axes.axhline(place - 0.5, color="#d0d0d0", linewidth=0.8)
            axes.locator_params(axis="x", nbins=5)
        panels[0].set_yticks(range(len(found)), [one.name for one in found])
        panels[0].axvline(100 * RANDOM / BEST, **RANDOM_LINE, label="random play")
        panels[0].axvline(100 * RESTRAINT / BEST, color="#555555", linestyle=":", label="scripted restraint")
        panels[0].set_xlim(0, 75)
        panels[0].invert_yaxis()
        sheet.title = "What governs the commons"
        sheet.caption = (
            f"Four learners, last {LAST} of 200 episodes; 95 % intervals by Student's t over replicas; "
            f"best: the best known policy, {BEST:,.0f} apples; rows of more than 75 % are off the scale; "
            "(1) to (8): Ostrom's principles."
        )


def main(*, out: Path = RESULTS / "governs") -> None:
    """Write the tables and the figure.

    Args:
        out: the directory.
    """
    found = rows()
    out.mkdir(parents=True, exist_ok=True)
    (out / "table.md").write_text(table(found), encoding="utf-8")
    (out / "elsewhere.md").write_text(elsewhere(), encoding="utf-8")
    draw(found, out / "governs.png")


if __name__ == "__main__":
    tyro.cli(main)
