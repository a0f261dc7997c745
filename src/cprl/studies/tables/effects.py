"""Main effects and interactions of the factors of a grid.

The main effect of a factor compares two of its levels: it is the difference between the means over all cells
of the grid with the one level and with the other. The interaction of two factors says how much larger the
effect of one factor is at a level of the other. Each effect is a weighted sum of the conditions, computed in
every replica. Its interval is by Student's t over replicas; Holm's method covers all effects on one metric.
"""

from collections.abc import Iterator, Sequence
from itertools import combinations, product
from math import prod
from typing import Any, Final

from cprl.measuring.registry import title
from cprl.measuring.statistics import CellWeights, Family, contrasts, crossed, main_effect, mean_difference
from cprl.pictures.readable import capitalised
from cprl.studies.study import level_text, short_names
from cprl.studies.tables.comparing import (
    INTERVALS,
    compared_metrics,
    difference_cell,
    episodes_text,
)
from cprl.studies.tables.tidy_table import TRAINING_PART, StudyDesign, StudyTable
from cprl.terminal.text_tables import TextTable

MOST_INTERACTIONS: Final = 24
"""The largest number of interactions. More are left out, since so many tests together show nothing."""


def effect_weights(table: StudyTable) -> dict[str, CellWeights]:
    """Return the weight of each condition in every main effect and interaction, by the name of the effect.

    Levels are compared with the lowest level if all are numbers, or else with the level of the reference. A
    table that is not a whole grid, see `is_whole_grid`, has no effects.
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
    """Return whether a table has paired replicas for all combinations of at least two factors."""
    design = table.design
    varied = [factor for factor in design.factors if len(set(design.levels(factor))) > 1]
    cells = {tuple(levels.values()) for levels in design.conditions.values()}
    combinations_of_all = prod(len(set(design.levels(factor))) for factor in design.factors)
    is_whole = len(cells) == len(design.conditions) == combinations_of_all
    return is_whole and len(varied) > 1 and design.is_paired and all(table.replicas.values())


def interactions_of(design: StudyDesign) -> int:
    """Return the number of interactions of two factors."""
    steps = [len(set(design.levels(factor))) - 1 for factor in design.factors]
    return sum(one * other for one, other in combinations(steps, 2))


def _main_effects(design: StudyDesign, factor: str) -> dict[str, CellWeights]:
    """Return the weights of conditions in each main effect of a factor, by the levels that it compares."""
    at = {name: levels[factor] for name, levels in design.conditions.items()}
    return {
        f"{level_text(level)} against {level_text(first)}": main_effect(at, level, first)
        for level, first in _compared_levels(design, factor)
    }


def _compared_levels(design: StudyDesign, factor: str) -> Iterator[tuple[Any, Any]]:
    """Yield each level of a factor with the level that it is compared with."""
    levels = list(dict.fromkeys(design.levels(factor)))
    if all(isinstance(level, bool | int | float) for level in levels):
        first, *others = sorted(levels)
    else:
        first = design.conditions[design.reference][factor]
        others = [level for level in levels if level != first]
    for level in others:
        yield level, first


def effects_of(table: StudyTable, metric: str, *, part: str = TRAINING_PART) -> Family:
    """Return the effects on a metric, by effect and metric."""
    rows = table.windows(part)
    return contrasts(rows, metric, "condition", effect_weights(table))


def effect_tables(
    table: StudyTable, metrics: Sequence[str] = (), *, part: str = TRAINING_PART
) -> list[TextTable]:
    """Return a table with a row for each effect and a column for each metric; [] if there are no effects."""
    names = list(effect_weights(table))
    if not names:
        return []
    chosen = compared_metrics(table, metrics, part=part)
    families = {metric: effects_of(table, metric, part=part) for metric in chosen}
    rows = []
    for name in names:
        effects = [family.get((name, metric)) for metric, family in families.items()]
        rows.append([name, *map(difference_cell, effects)])
    what = (
        "effects of the factors, differences between means over all cells, paired by replica; with x, how "
        "much larger the first difference is at the second factor's level"
    )
    note = families[chosen[0]].note("of a column")
    if (left_out := interactions_of(table.design)) > MOST_INTERACTIONS:
        note += f" The {left_out} interactions of two factors are left out."
    heading = f"{capitalised(episodes_text(table, part))}; {what}; {INTERVALS}."
    return [TextTable(heading, ["effect", *map(title, chosen)], rows, note)]
