"""Effects of the factors of a grid: means over its cells compared within each replica.

A main effect of a factor is the difference between the means over all cells at two of its levels. An
interaction of two factors is how much larger the effect of the one is at a level of the other. Each is a
weighted sum of the conditions within a replica; its interval is by Student's t over replicas, and Holm's
method is for all effects on one metric together.
"""

from collections.abc import Iterator, Sequence
from itertools import combinations, product
from math import prod
from typing import Any, Final

from cprl.measuring.registry import title
from cprl.measuring.statistics import Family, Weights, contrasts, crossed, main_effect, mean_difference
from cprl.studies.study import level_text, short_names
from cprl.studies.tables.comparing import (
    INTERVALS,
    capitalised,
    change,
    episodes_text,
    metrics_of,
)
from cprl.studies.tables.table import TRAINING, Design, StudyTable
from cprl.terminal.tables import Cells

MOST_INTERACTIONS: Final = 24
"""More are left out: so many tests together would show nothing."""

Levels = tuple[Any, Any]
"""A level of a factor, and the one that it is compared with."""


def weights_of(table: StudyTable) -> dict[str, Weights]:
    """Return what each condition counts in the main effects of a grid and its interactions of two factors, by
    their names; none where it has a single factor, a cell without a replica, or replicas that are not paired.

    Levels are compared with the lowest one where all are numbers, else with that of the reference.
    """
    design = table.design
    if not (design.is_grid and is_whole_grid(table)):
        return {}
    short = short_names(design.factors)
    effects = {factor: _main_effects(design, factor) for factor in design.factors}
    weights = {}
    for factor, by_levels in effects.items():
        for against, signs in by_levels.items():
            weights[f"{short[factor]} {against}"] = mean_difference(signs)
    if interactions_of(design) > MOST_INTERACTIONS:
        return weights
    for one, other in combinations(design.factors, 2):
        for first, second in product(effects[one], effects[other]):
            name = f"{short[one]} {first} x {short[other]} {second}"
            signs = crossed(effects[one][first], effects[other][second])
            weights[name] = {cell: 2 * weight for cell, weight in mean_difference(signs).items()}
    return weights


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


def _main_effects(design: Design, factor: str) -> dict[str, Weights]:
    """Return the signs of the conditions in each effect of a factor, by the levels that it compares."""
    at = {name: levels[factor] for name, levels in design.conditions.items()}
    return {
        f"{level_text(level)} against {level_text(first)}": main_effect(at, level, first)
        for level, first in _compared_levels(design, factor)
    }


def _compared_levels(design: Design, factor: str) -> Iterator[Levels]:
    levels = list(dict.fromkeys(design.levels(factor)))
    if all(isinstance(level, bool | int | float) for level in levels):
        first, *others = sorted(levels)
    else:
        first = design.conditions[design.reference][factor]
        others = [level for level in levels if level != first]
    for level in others:
        yield level, first


def effects_of(table: StudyTable, metric: str, *, part: str = TRAINING) -> Family:
    """Return the effects of a grid on a metric, by effect and metric; none where there is no grid."""
    rows = table.windows(part)
    return contrasts(rows, metric, "condition", weights_of(table))


def effect_cells(table: StudyTable, metrics: Sequence[str] = (), *, part: str = TRAINING) -> list[Cells]:
    """Return a row for each effect of a grid, a column for each metric; nothing where there are none."""
    names = list(weights_of(table))
    if not names:
        return []
    chosen = metrics_of(table, metrics, part=part)
    families = {metric: effects_of(table, metric, part=part) for metric in chosen}
    rows = []
    for name in names:
        of_row = [family.get((name, metric)) for metric, family in families.items()]
        rows.append([name, *map(change, of_row)])
    what = (
        "effects of the factors, differences between means over all cells, paired by replica; with x, how "
        "much larger the first difference is at the second factor's level"
    )
    note = families[chosen[0]].note("of a column")
    if (left_out := interactions_of(table.design)) > MOST_INTERACTIONS:
        note += f" The {left_out} interactions of two factors are left out."
    heading = f"{capitalised(episodes_text(table, part))}; {what}; {INTERVALS}."
    return [Cells(heading, ["effect", *map(title, chosen)], rows, note)]
