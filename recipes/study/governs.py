"""What governs the commons? One figure and one table of every factor that the committed studies vary.

    python recipes/study/governs.py

To be run in the root of the repository: reads tables and runs in docs/results, and writes into
docs/results/governs table.md, governs.png, and elsewhere.md, six of the changes in the settings of
elsewhere.py. In the conditions of table.md four DQN agents play `commons` as run, 200 episodes on the short
schedule of base.py, with one thing changed, in the rows of PPO also the algorithm. Numbers are means over
replicas of the last 30 episodes of each, "while learning", or of its 50 fresh episodes, "frozen".
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final, Literal

import numpy as np
import tyro
from base import EXPERIMENT
from effects import marked
from page import table
from possible import KNOWN

from cprl.measuring.registry import METRICS
from cprl.measuring.statistics import Estimate, difference, estimate, judge_family
from cprl.pictures.colours import BLUE, GREEN, GREY, ORANGE, PURPLE, VERMILION
from cprl.studies import StudyTable
from cprl.studies.tables.comparing import values_of as replicas_of
from cprl.studies.tables.pooled import pooled_table
from cprl.terminal import style
from cprl.terminal.panels import draw_dots
from cprl.values.array_types import Float64

RESULTS: Final = Path("docs", "results")
LAST: Final = 30
"""Episodes at the end of each replica."""
SCHEDULE: Final = EXPERIMENT.agents[0].algorithm.settings
"""The schedule of the exploration of DQN agents."""
AT_MOST: Final = {
    "regrowth x 0.25": 717,
    "regrowth x 0.5": 1344,
    "regrowth x 2": 4000,
    "regrowth x 4": 4000,
    "half the apples, scattered": 484,
    "as many apples, scattered": 2039,
    "twice the apples, scattered": 4000,
    "as many apples, in patches": 4000,
    "half the board": 1292,
    "twice the board": 4000,
    "four times the board": 4000,
    "quarters, open": 2189,
    "quarters, walls with a door": 2189,
    "quarters, walls": 2189,
    "2 agents": 2000,
}
"""The apples that nobody can exceed on average in an episode, where they are not those of the unchanged game:
the smaller of an apple for each agent and turn, and of the bound of `yield_bounds` with the first stock, as
in possible.py."""

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
"""The names of the runs of recipes/institutions.py, with the number of Ostrom's principle."""

NONE: Final = ("institutions", "name=institutions_none", "nothing changed")
STUDIES: Final = {
    "none": [NONE],
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
        ("networks", "two layers of 32", "PPO"),
        ("networks", "GRU of 32", "PPO with memory (GRU)"),
        ("networks", "convolutions", "PPO with convolutions"),
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
        *(("institutions", f"name=institutions_{run}", name) for run, name in INSTITUTIONS.items()),
    ],
}
"""By group: the study, its condition, and the name here."""

AS_HERE: Final = {
    "twice the apples": ("space", "twice the apples, scattered", "commons"),
    "regrowth x 2": ("regrowth", "regrowth=2", "regrowth=1"),
    "half the agents": ("agents", "2, same board", "4"),
    "networks of 2 units": ("network_width", "hidden_cells=(2, 2)", "hidden_cells=(32, 32)"),
    "quota": ("institutions", "name=institutions_quota", NONE[1]),
    "penalty that is certain": ("rules", "automatic penalty", "none"),
}
"""The changes of recipes/study/elsewhere.py: where they are on the short schedule, and what beside."""

RANDOM: Final = 282.0
RESTRAINT: Final = 926.0
"""Apples an episode of random play (docs/institutions.md) and of the scripted "sustainable" agents
(docs/results/schelling/table.md), on the unchanged game."""
TICKS: Final = (50, 100, 200, 500, 2000)
"""Apples, on the axis of the figure."""

Part = Literal["training", "evaluation"]


@dataclass(frozen=True, kw_only=True)
class Row:
    """A condition and its measurements over replicas."""

    group: str
    name: str
    replicas: int
    income: Estimate
    """Apples of all agents together, after fines and transfers, while they learn."""
    frozen: Estimate
    """The same of their frozen weights in fresh worlds."""
    trend: Estimate
    """Income in the last 30 episodes of training minus the 30 before."""
    survival: Estimate
    """The turns of an episode."""
    equality: Estimate
    """The equality of the harvest."""
    income_equality: Estimate
    turns: float
    """The turns of the whole training, from each of which agents learn."""
    exploration: str
    """The share of random actions in the last 30 episodes, from the first of them to the end."""

    @property
    def cells(self) -> list[str]:
        """Return the texts of a row of the table."""
        most = AT_MOST.get(self.name, KNOWN["commons", "as_run"].at_most)
        return [
            *(self.name, GROUPS[self.group][1], str(self.replicas), text_of(self.income)),
            *(text_of(self.frozen), text_of(self.trend, sign="+"), f"{self.income.value / most:.0%}"),
            *(text_of(self.survival, most=1000), text_of(self.equality, most=1)),
            *(text_of(self.income_equality, most=1), f"{self.turns:,.0f}", self.exploration),
        ]


COLUMNS: Final = (
    *("changed", "group", "replicas", "income while learning, apples", "income frozen"),
    *("last 30 minus the 30 before", "share of the most possible", "survival, turns"),
    *("equality of the harvest", "equality of income", "turns of training", "exploration at the end"),
)


@cache
def table_of(study: str) -> StudyTable:
    """Return the committed table of a study, or that of the runs of recipes/institutions.py."""
    if study == "institutions":
        return pooled_table([RESULTS / study], by=["name"])
    return StudyTable.read(RESULTS / "studies" / study / "table.parquet")


@cache
def _by_condition(study: str, metric: str, part: Part, last: int) -> Mapping[str, Mapping[int, float]]:
    return replicas_of(table_of(study).windows(part, last=last), metric)


def values_of(study: str, condition: str, metric: str, part: Part = "training", last: int = LAST) -> Float64:
    """Return a metric of each replica; "income" is the income, and without money the harvest."""
    values = _by_condition(study, metric, part, last).get(condition)
    same_as = METRICS[metric].same_as
    if not values and same_as is not None:
        values = _by_condition(study, same_as, part, last)[condition]
    return np.array(list(values.values()))


def row_of(group: str, study: str, condition: str, name: str) -> Row:
    """Return a condition of a study as a row."""

    def mean(metric: str, part: Part = "training") -> Estimate:
        return estimate(values_of(study, condition, metric, part))

    income = values_of(study, condition, "income")
    income_of_60 = values_of(study, condition, "income", last=2 * LAST)
    turns = (
        values_of(study, condition, "survival_steps", last=EXPERIMENT.episodes).mean() * EXPERIMENT.episodes
    )
    survival = mean("survival_steps")
    exploration = "of its policy"
    if study != "networks":
        steps = (turns - survival.value * LAST, turns)
        epsilons = [f"{SCHEDULE.epsilon(int(step)):.2f}" for step in steps]
        exploration = " to ".join(dict.fromkeys(epsilons))
    return Row(
        group=group,
        name=name,
        replicas=len(income),
        income=estimate(income),
        frozen=mean("income", "evaluation"),
        trend=estimate(2 * (income - income_of_60)),
        survival=survival,
        equality=mean("equality"),
        income_equality=mean("income_equality"),
        turns=turns,
        exploration=exploration,
    )


def rows() -> list[Row]:
    """Return all conditions, group by group, in each the largest income first."""
    every = []
    for group, conditions in STUDIES.items():
        group_rows = [row_of(group, *condition) for condition in conditions]
        every += sorted(group_rows, key=lambda row: -row.income.value)
    return every


def text_of(one: Estimate, most: float = np.inf, sign: str = "") -> str:
    """Return a mean with its interval, which ends at the most that is possible."""
    digits = 2 if one.high < 5 and not sign else 0
    value, low, high = (f"{min(number, most):{sign},.{digits}f}" for number in (one.value, one.low, one.high))
    return f"{value} [{low}, {high}]"


LONGER: Final = {"PPO, 256 worlds": 256, "DQN, full schedule": 1_000}
"""Episodes at the end, by setting: one of each world, since the last 30 of 256 worlds are the longest ones;
and as many as agents need that go up and down over hundreds, chosen after the last 30 were seen."""


def elsewhere() -> list[str]:
    """Return tables in Markdown of what each change adds by setting, and how many times the income it
    gives."""
    longer = "While learning, longer ends: 256 episodes of PPO, 1,000 of the full schedule:"
    return [
        "Income, apples, and what each change adds, paired by replica.",
        "Stars: not 0 by Holm's method for the 24 changes of the last four columns together, and for the six "
        "of the first column.",
        "",
        *("While learning, the last 30 episodes:", "", *elsewhere_table("training", {})),
        *(longer, "", *elsewhere_table("training", LONGER)),
        *("Frozen, in fresh worlds:", "", *elsewhere_table("evaluation", {})),
    ]


def elsewhere_table(part: Part, last: Mapping[str, int]) -> list[str]:
    """Return a table of what each change adds by setting."""
    conditions = table_of("elsewhere").design.conditions
    settings = list(dict.fromkeys(name.partition(": ")[0] for name in conditions))
    bases = {}
    changed = []
    for setting in settings:
        episodes = last.get(setting, LAST)
        base, *others = (
            values_of("elsewhere", f"{setting}: {change}", "income", part, episodes)
            for change in ("nothing changed", *AS_HERE)
        )
        bases[setting] = base
        changed += [(income, base) for income in others]
    texts = change_texts(changed)
    columns = [texts[first : first + len(AS_HERE)] for first in range(0, len(texts), len(AS_HERE))]
    if part == "training":
        here = [
            (values_of(study, name, "income"), values_of(study, base, "income"))
            for study, name, base in AS_HERE.values()
        ]
        bases = {"DQN, 1 world": here[0][1], **bases}
        columns.insert(0, change_texts(here))
    lines = [["nothing changed", *(text_of(estimate(base)) for base in bases.values())]]
    lines += zip(AS_HERE, *columns, strict=True)
    return table(["apples", *bases], lines, numbers=len(bases))


def change_texts(pairs: Sequence[tuple[Float64, Float64]]) -> list[str]:
    """Return the difference of each, paired by replica, and the ratio; stars by Holm's method for all of
    these."""
    changes = {(str(place),): difference(*pair, paired=True) for place, pair in enumerate(pairs)}
    texts = marked(judge_family(changes).values())
    ratios = [value.mean() / base.mean() for value, base in pairs]
    return [f"{text}, x {ratio:.1f}" for text, ratio in zip(texts, ratios, strict=True)]


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draw income, survival and equality of each condition."""
    titles = {"income": "income, apples (log)", "survival": "survival, turns"}
    titles |= {"income_equality": "equality of income"}
    with style.drawing(path) as sheet:
        panels = sheet.panels(3, columns=3, high=1.5 * len(rows) + 4, sharey=True)
        for axes, (metric, title) in zip(panels, titles.items(), strict=True):
            for group, (colour, label) in GROUPS.items():
                places = [place for place, row in enumerate(rows) if row.group == group]
                means = [getattr(rows[place], metric) for place in places]
                draw_dots(axes, places, means, across=True, color=np.array(colour) / 255, label=label)
                axes.axhline(places[-1] + 0.5, color="#d0d0d0", linewidth=0.8)
            axes.set_title(title)
            axes.grid(axis="x", alpha=0.3)
            if metric != "income":
                axes.locator_params(axis="x", nbins=5)
        income = panels[0]
        income.set_yticks(range(len(rows)), [row.name for row in rows])
        income.axvline(RANDOM, **style.RANDOM_LINE, label="random play")
        income.axvline(RESTRAINT, color="#555555", linestyle=":", label="scripted restraint")
        income.set_xscale("log")
        income.set_xticks(TICKS, [f"{apples:,}" for apples in TICKS])
        income.minorticks_off()
        income.set_ylim(len(rows) - 0.3, -0.7)
        sheet.title = "What governs the commons"
        sheet.caption = (
            f"Four learners, last {LAST} of 200 episodes; 95 % intervals by Student's t over replicas. "
            "Green rows have boards that bear more or fewer apples; lines are of the unchanged one. "
            "(1) to (8): Ostrom's principles."
        )


def main(*, out: Path = RESULTS / "governs") -> None:
    """Write the tables and the figure.

    Args:
        out: the directory.
    """
    every = rows()
    out.mkdir(parents=True, exist_ok=True)
    lines = table(COLUMNS, [row.cells for row in every], numbers=len(COLUMNS) - 2)
    (out / "table.md").write_text("\n".join(lines), encoding="utf-8")
    (out / "elsewhere.md").write_text("\n".join(elsewhere()), encoding="utf-8")
    draw(every, out / "governs.png")


if __name__ == "__main__":
    tyro.cli(main)
