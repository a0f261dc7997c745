"""Effects of the factors of a grid: means over its cells compared within each replica.

A main effect of a factor is the difference between the means over all cells at two of its levels. An
interaction of two factors is how much larger the effect of the one is at a level of the other. Each is a
weighted sum of the conditions within a replica; its interval is by Student's t over replicas, and Holm's
method is for all effects on one metric together.
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations, product
from math import isnan, prod
from typing import Any, Final, NamedTuple

from cprl.measuring.statistics import Estimate, estimate
from cprl.studies.study import level_text, short_names
from cprl.studies.tables.comparing import (
    INTERVALS,
    Comparison,
    Family,
    compare,
    family_of,
    metric_title,
    metrics_of,
)
from cprl.studies.tables.table import TRAINING, Design, StudyTable
from cprl.system.defaults import LAST
from cprl.terminal.tables import Cells

MOST_INTERACTIONS: Final = 24
"""More are left out: so many tests together would show nothing."""

Weights = dict[str, float]
"""What each condition counts in an effect, by its name; together 0."""
Levels = tuple[Any, Any]
"""A level of a factor, and the one that it is compared with."""


def contrast(comparison: Comparison, weights: Weights) -> Estimate | None:
    """Return a weighted sum of conditions within a replica, over the replicas that have a value in each; None
    where none has."""
    by_condition = {name: comparison.by_name[name].values for name, weight in weights.items() if weight}
    replicas = set.intersection(*(set(values) for values in by_condition.values()))
    sums = [
        sum(weights[name] * values[replica] for name, values in by_condition.items())
        for replica in sorted(replicas)
    ]
    defined = [value for value in sums if not isnan(value)]
    return estimate(defined) if defined else None


def effects_of(table: StudyTable) -> dict[str, Weights]:
    """Return the main effects of a grid and its interactions of two factors, by name; none where it has a
    single factor, a cell without a replica, or replicas that are not paired.

    Levels are compared with the lowest one where all are numbers, else with that of the reference.
    """
    design = table.design
    if not (design.is_grid and is_whole_grid(table)):
        return {}
    short = short_names(design.factors)
    pairs = {factor: list(_compared_levels(design, factor)) for factor in design.factors}
    effects = {
        f"{short[factor]} {_against(levels)}": _weights(design, {factor: levels})
        for factor in design.factors
        for levels in pairs[factor]
    }
    if interactions_of(design) > MOST_INTERACTIONS:
        return effects
    for one, other in combinations(design.factors, 2):
        for first, second in product(pairs[one], pairs[other]):
            name = f"{short[one]} {_against(first)} x {short[other]} {_against(second)}"
            effects[name] = _weights(design, {one: first, other: second})
    return effects


def is_whole_grid(table: StudyTable) -> bool:
    """Return whether a table has each combination of the levels of two factors or more, in pairs."""
    design = table.design
    varied = [factor for factor in design.factors if len(set(design.levels(factor))) > 1]
    cells = {tuple(levels.values()) for levels in design.conditions.values()}
    combinations_of_all = prod(len(set(design.levels(factor))) for factor in design.factors)
    is_whole = len(cells) == len(design.conditions) == combinations_of_all
    return is_whole and len(varied) > 1 and design.is_paired and all(table.replicas.values())


def interactions_of(design: Design) -> int:
    """Return how many interactions of two factors there are."""
    steps = [len(set(design.levels(factor))) - 1 for factor in design.factors]
    return sum(one * other for one, other in combinations(steps, 2))


def _compared_levels(design: Design, factor: str) -> Iterator[Levels]:
    levels = list(dict.fromkeys(design.levels(factor)))
    if all(isinstance(level, bool | int | float) for level in levels):
        first, *others = sorted(levels)
    else:
        first = design.conditions[design.reference][factor]
        others = [level for level in levels if level != first]
    for level in others:
        yield level, first


def _against(levels: Levels) -> str:
    return f"{level_text(levels[0])} against {level_text(levels[1])}"


def _weights(design: Design, levels: Mapping[str, Levels]) -> Weights:
    """Return the weights of the effect of one factor, or of the interaction of two."""
    signs: Weights = {}
    for name, at in design.conditions.items():
        sign = 1.0
        for factor, (level, first) in levels.items():
            sign *= (at[factor] == level) - float(at[factor] == first)
        signs[name] = sign
    cells = sum(sign > 0 for sign in signs.values()) / 2 ** (len(levels) - 1)
    return {name: sign / cells for name, sign in signs.items()}


class Effects(NamedTuple):
    """The effects on a metric."""

    comparison: Comparison
    estimates: Mapping[str, Estimate | None]
    """By the name of the effect."""
    family: Family
    """Of all of them."""

    def is_marked(self, name: str) -> bool:
        """Return whether an effect is not 0 by Holm's method."""
        return (self.comparison.metric, name) in self.family.marked


def estimated(table: StudyTable, comparison: Comparison) -> Effects:
    """Return the effects of a grid on a metric."""
    estimates = {name: contrast(comparison, weights) for name, weights in effects_of(table).items()}
    family = family_of({(comparison.metric, name): one for name, one in estimates.items()})
    return Effects(comparison, estimates, family)


def effect_cells(
    table: StudyTable, metrics: Sequence[str] = (), *, part: str = TRAINING, last: int = LAST
) -> list[Cells]:
    """Return a row for each effect of a grid, a column for each metric; nothing where there are none."""
    names = list(effects_of(table))
    if not names:
        return []
    chosen = metrics_of(table, metrics, part=part)
    each = [estimated(table, compare(table, metric, part=part, last=last)) for metric in chosen]
    rows = [[name, *(_text(effects, name) for effects in each)] for name in names]
    episodes = each[0].comparison.episodes_text
    what = (
        "effects of the factors, differences between means over all cells, paired by replica; with x, how "
        "much larger the first difference is at the second factor's level"
    )
    note = each[0].family.note("of a column")
    if (left_out := interactions_of(table.design)) > MOST_INTERACTIONS:
        note += f" The {left_out} interactions of two factors are left out."
    heading = f"{episodes[0].upper()}{episodes[1:]}; {what}; {INTERVALS}."
    return [Cells(heading, ["effect", *map(metric_title, chosen)], rows, note)]


def _text(effects: Effects, name: str) -> str:
    one = effects.estimates[name]
    if one is None:
        return "-"
    return f"**{one:+}**" if effects.is_marked(name) else f"{one:+}"
