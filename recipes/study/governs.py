"""What governs the commons? One figure and one table of every factor that the committed studies vary.

    python recipes/study/governs.py

To be run in the root of the repository: reads tables in docs/results, and writes into docs/results/governs
table.md, governs.png, and elsewhere.md, six of the changes in the settings of elsewhere.py. In the conditions
of table.md four DQN agents play `commons` as run, 200 episodes on the short schedule of base.py, with one
thing changed, in the rows of PPO also the algorithm. Numbers are means over replicas of the last 30 episodes
of each, "while learning", or of its 50 fresh episodes, "frozen".
"""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Final, Literal, NamedTuple

import numpy as np
import tyro
from base import EXPERIMENT
from effects import marked
from numpy.typing import NDArray
from possible import KNOWN

from cprl.measuring.registry import METRICS
from cprl.measuring.statistics import Estimate, difference, estimate, judged
from cprl.pictures.colours import BLUE, GREEN, GREY, ORANGE, PURPLE, VERMILION
from cprl.runs.curves import as_curves, curves_of
from cprl.runs.episodes import read_table
from cprl.studies import StudyTable
from cprl.studies.tables.comparing import values_of as replicas_of
from cprl.terminal import style
from cprl.terminal.style import RANDOM_LINE

RESULTS: Final = Path("docs", "results")
LAST: Final = 30
"""Episodes at the end of each replica."""
SCHEDULE: Final = EXPERIMENT.agents[0].algorithm.settings
"""Of the exploration of DQN agents."""
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
"""What nobody can exceed on average in an episode, in apples, where it is not that of the unchanged game: the
smaller of an apple for each agent and turn, and of the bound of `yield_bounds` with the first
stock, as in possible.py."""

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
TICKS: Final = (50, 100, 200, 500, 2000)
"""Apples, on the axis of the figure."""


Part = Literal["training", "evaluation"]


class Row(NamedTuple):
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
    """Turns."""
    equality: Estimate
    """Of the harvest."""
    income_equality: Estimate
    turns: float
    """Of the whole training, from each of which agents learn."""
    exploration: str
    """The share of random actions in the last 30 episodes, from the first of them to the end."""

    @property
    def share(self) -> float:
        """Of the most that is possible."""
        return self.income.value / AT_MOST.get(self.name, KNOWN["commons", "as_run"].at_most)


@cache
def table_of(study: str) -> StudyTable:
    """The committed table of a study."""
    return StudyTable.read(RESULTS / "studies" / study / "table.parquet")


def values_of(
    study: str, condition: str, metric: str, part: Part = "training", last: int = LAST
) -> NDArray[np.float64]:
    """A metric of each replica; "income" is the income, and without money the harvest."""
    values = by_condition(study, metric, part, last).get(condition)
    same_as = METRICS[metric].same_as
    if not values and same_as is not None:
        values = by_condition(study, same_as, part, last)[condition]
    return np.array(list(values.values()))


@cache
def by_condition(study: str, metric: str, part: Part, last: int) -> dict[str, dict[int, float]]:
    """A metric of each replica, by condition."""
    return replicas_of(table_of(study).windows(part, last=last), metric)


def nets(study: str, condition: str, part: Part = "training", last: int = LAST) -> NDArray[np.float64]:
    """The income of each replica, in apples."""
    if study == "institutions":
        return np.nanmean(curves_of(RESULTS / study / condition)["income"][:, -LAST:], 1)
    return values_of(study, condition, "income", part, last)


def of_study(group: str, study: str, condition: str, name: str) -> Row:
    """A condition of a study."""
    income = values_of(study, condition, "income")
    of_both = values_of(study, condition, "income", last=2 * LAST)
    turns = values_of(study, condition, "survival_steps")
    of_all = values_of(study, condition, "survival_steps", last=EXPERIMENT.episodes)
    return Row(
        group=group,
        name=name,
        replicas=len(income),
        income=estimate(income),
        frozen=estimate(values_of(study, condition, "income", "evaluation")),
        trend=estimate(2 * (income - of_both)),
        survival=estimate(turns),
        equality=estimate(values_of(study, condition, "equality")),
        income_equality=estimate(values_of(study, condition, "income_equality")),
        turns=of_all.mean() * EXPERIMENT.episodes,
        exploration="of its policy" if study == "networks" else explored(of_all.mean(), turns.mean()),
    )


def of_run(group: str, folder: str, name: str) -> Row:
    """A run of recipes/institutions.py."""
    run = RESULTS / "institutions" / folder
    curves = curves_of(run)
    fresh = as_curves(read_table(run / "evaluation" / "trained.parquet"))
    income = curves["income"]
    ends = at_end(income)
    turns = curves["survival_steps"]
    return Row(
        group=group,
        name=name,
        replicas=len(income),
        income=estimate(ends),
        frozen=estimate(fresh["income"].mean(1)),
        trend=estimate(ends - income[:, -2 * LAST : -LAST].mean(1)),
        survival=estimate(at_end(turns)),
        equality=estimate(at_end(curves["equality"])),
        income_equality=estimate(at_end(income_equality(curves))),
        turns=turns.mean() * EXPERIMENT.episodes,
        exploration=explored(turns.mean(), turns[:, -LAST:].mean()),
    )


def income_equality(curves: Mapping[str, NDArray[np.float64]]) -> NDArray[np.float64]:
    """The equality of income by episode, which without money is that of the harvest."""
    return curves.get("income_equality", curves["equality"])


def at_end(curve: NDArray[np.float64]) -> NDArray[np.float64]:
    """The mean of the last episodes of each replica, [R]."""
    return np.nanmean(curve[:, -LAST:], 1)


def explored(turns: float, last_turns: float) -> str:
    """Epsilon at the beginning of the last episodes and at the end of the training.

    Args:
        turns: of an episode, the mean over all of them.
        last_turns: of one of the last.
    """
    at_the_end = turns * EXPERIMENT.episodes
    before = at_the_end - last_turns * LAST
    epsilons = [f"{SCHEDULE.epsilon(int(steps)):.2f}" for steps in (before, at_the_end)]
    return " to ".join(dict.fromkeys(epsilons))


def rows() -> list[Row]:
    """All conditions, group by group, in each the largest income first."""
    found = [of_run("none", "none", "nothing changed")]
    for group, conditions in STUDIES.items():
        found += [of_study(group, *condition) for condition in conditions]
    found += [of_run("institutions", folder, name) for folder, name in INSTITUTIONS.items()]
    order = list(GROUPS)
    return sorted(found, key=lambda one: (order.index(one.group), -one.income.value))


def text_of(found: Estimate, most: float = np.inf, sign: str = "") -> str:
    """A mean with its interval, which ends at the most that is possible."""
    digits = 2 if found.high < 5 and not sign else 0
    numbers = found.value, found.low, found.high
    value, low, high = (f"{min(number, most):{sign},.{digits}f}" for number in numbers)
    return f"{value} [{low}, {high}]"


def table(found: list[Row]) -> str:
    """The table in Markdown."""
    columns = [
        *("changed", "group", "replicas", "income while learning, apples", "income frozen"),
        *("last 30 minus the 30 before", "share of the most possible", "survival, turns"),
        *("equality of the harvest", "equality of income", "turns of training"),
        "exploration at the end",
    ]
    lines = [f"| {' | '.join(columns)} |", "|---|---|" + "---:|" * (len(columns) - 2)]
    for one in found:
        cells = [
            *(one.name, GROUPS[one.group][1], str(one.replicas), text_of(one.income), text_of(one.frozen)),
            *(text_of(one.trend, sign="+"), f"{one.share:.0%}", text_of(one.survival, most=1000)),
            *(text_of(one.equality, most=1), text_of(one.income_equality, most=1)),
            *(f"{one.turns:,.0f}", one.exploration),
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join([*lines, ""])


LONGER: Final = {"PPO, 256 worlds": 256, "DQN, full schedule": 1_000}
"""Episodes at the end, by setting: one of each world, since the last 30 of 256 worlds are the longest ones;
and as many as agents need that go up and down over hundreds, chosen after the last 30 were seen."""


def elsewhere() -> str:
    """Tables in Markdown of what each change adds by setting, and how many times the income it gives."""
    parts: list[tuple[str, Part, Mapping[str, int]]] = [
        ("While learning, the last 30 episodes", "training", {}),
        ("While learning, longer ends: 256 episodes of PPO, 1,000 of the full schedule", "training", LONGER),
        ("Frozen, in fresh worlds", "evaluation", {}),
    ]
    lines = [
        "Income, apples, and what each change adds, paired by replica.",
        "Stars: not 0 by Holm's method for the 24 changes of the last four columns together, and for the six "
        "of the first column.",
        "",
    ]
    for title, part, last in parts:
        lines += [f"{title}:", "", *elsewhere_table(part, last), ""]
    return "\n".join(lines)


def elsewhere_table(part: Part, last: Mapping[str, int]) -> list[str]:
    """A table of what each change adds by setting."""
    conditions = table_of("elsewhere").design.conditions
    settings = list(dict.fromkeys(name.partition(": ")[0] for name in conditions))
    bases, pairs = [], []
    for setting in settings:
        episodes = last.get(setting, LAST)
        base = nets("elsewhere", f"{setting}: nothing changed", part, episodes)
        bases.append(text_of(estimate(base)))
        pairs += [(nets("elsewhere", f"{setting}: {change}", part, episodes), base) for change in AS_HERE]
    texts = changes(pairs)
    columns = [texts[first : first + len(AS_HERE)] for first in range(0, len(texts), len(AS_HERE))]
    if part == "training":
        here = [(nets(study, name), nets(study, base)) for study, name, base in AS_HERE.values()]
        settings.insert(0, "DQN, 1 world")
        bases.insert(0, text_of(estimate(here[0][1])))
        columns.insert(0, changes(here))
    lines = [f"| apples | {' | '.join(settings)} |", "|---|" + "---:|" * len(settings)]
    lines.append(f"| nothing changed | {' | '.join(bases)} |")
    for change, *cells in zip(AS_HERE, *columns, strict=True):
        lines.append(f"| {change} | {' | '.join(cells)} |")
    return lines


def changes(pairs: list[tuple[NDArray[np.float64], NDArray[np.float64]]]) -> list[str]:
    """The difference of each, paired by replica, and the ratio; stars by Holm's method for all of these."""
    found = {(str(place),): difference(*pair, paired=True) for place, pair in enumerate(pairs)}
    texts = marked(judged(found).values())
    ratios = [value.mean() / base.mean() for value, base in pairs]
    return [f"{text}, x {ratio:.1f}" for text, ratio in zip(texts, ratios, strict=True)]


def draw(found: list[Row], path: Path) -> None:
    """Draw income, survival and equality of each condition."""
    panels_of = {"income": "income, apples (log)", "survival": "survival, turns"}
    panels_of |= {"income_equality": "equality of income"}
    with style.drawing(path) as sheet:
        panels = sheet.panels(3, columns=3, high=1.5 * len(found) + 4, sharey=True)
        for axes, (metric, title) in zip(panels, panels_of.items(), strict=True):
            named: set[str] = set()
            for place, one in enumerate(found):
                colour, group = GROUPS[one.group]
                measured = getattr(one, metric)
                shade = np.array(colour) / 255
                axes.plot([measured.low, measured.high], [place, place], color=shade, linewidth=2)
                label = group if axes is panels[0] and group not in named else None
                axes.plot([measured.value], [place], "o", color=shade, markersize=5, label=label)
                named.add(group)
            axes.set_title(title)
            axes.grid(axis="x", alpha=0.3)
            groups = [one.group for one in found]
            for place in range(1, len(found)):
                if groups[place] != groups[place - 1]:
                    axes.axhline(place - 0.5, color="#d0d0d0", linewidth=0.8)
            if metric != "income":
                axes.locator_params(axis="x", nbins=5)
        panels[0].set_yticks(range(len(found)), [one.name for one in found])
        panels[0].axvline(RANDOM, **RANDOM_LINE, label="random play")
        panels[0].axvline(RESTRAINT, color="#555555", linestyle=":", label="scripted restraint")
        panels[0].set_xscale("log")
        panels[0].set_xticks(TICKS, [f"{apples:,}" for apples in TICKS])
        panels[0].minorticks_off()
        panels[0].set_ylim(len(found) - 0.3, -0.7)
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
    found = rows()
    out.mkdir(parents=True, exist_ok=True)
    (out / "table.md").write_text(table(found), encoding="utf-8")
    (out / "elsewhere.md").write_text(elsewhere(), encoding="utf-8")
    draw(found, out / "governs.png")


if __name__ == "__main__":
    tyro.cli(main)
