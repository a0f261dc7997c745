"""Main effects and interactions of the design of recipes/study/together.py, from the study's table.

    python recipes/study/effects.py studies/together
    python recipes/study/effects.py studies/together --part evaluation

Prints a table in Markdown. An effect is the mean at the high level of a factor, or where the product of two
factors is high, minus the mean elsewhere, in each replica; intervals are of replicas, by Student's t. Stars
are what Holm's method leaves for all effects of one column. Interactions that the design cannot tell apart
stand together. Monitoring and sanctions are in the game only where a quota or boundaries are, in twelve of
the sixteen combinations: their effects here are not what they do there, see contrasts.py.
"""

from collections import defaultdict
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np
import tyro
from numpy.typing import NDArray
from together import FACTORS, design, name

from cprl.measuring.statistics import Estimate, estimate, holm
from cprl.studies import StudyTable
from cprl.studies.tables.comparing import compare

METRICS: Final = {"income": "income, apples", "survival_steps": "survival, turns"}


def measured(table: StudyTable, metric: str, part: str = "training") -> NDArray[np.float64]:
    """The mean of each replica, float [conditions, R], as in `design`."""
    found = compare(table, metric, part=part).by_name
    return np.array([found[name(levels)].defined for levels in design()])


def effects(values: NDArray[np.float64]) -> dict[str, Estimate]:
    """Each effect by its name: main effects, then groups of interactions of two factors.

    Args:
        values: float [conditions, R], in the order of `design`.
    """
    signs = {factor: np.array([1.0 if levels[factor] else -1.0 for levels in design()]) for factor in FACTORS}
    groups: dict[tuple[float, ...], list[str]] = defaultdict(list)
    for one, other in combinations(FACTORS, 2):
        groups[tuple(signs[one] * signs[other])].append(f"{one} x {other}")
    contrasts = signs | {" = ".join(names): np.array(column) for column, names in groups.items()}
    half = len(values) / 2
    return {label: estimate(column @ values / half) for label, column in contrasts.items()}


def marked(differences: Sequence[Estimate]) -> list[str]:
    """Texts with signs, and with stars by Holm's method for all of them."""
    stars = holm([difference.p_value for difference in differences])
    return [f"{one:+}{'*' if star else ''}" for one, star in zip(differences, stars, strict=True)]


def main(
    study: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    part: Literal["training", "evaluation"] = "training",
) -> None:
    """Print the effects.

    Args:
        study: the study's directory.
        part: the last 30 episodes of training, or fresh episodes of the agents at its end, frozen.
    """
    table, columns = StudyTable.read(study / "table.parquet"), []
    for metric in METRICS:
        found = effects(measured(table, metric, part))
        columns.append(dict(zip(found, marked(list(found.values())), strict=True)))
    print(f"| effect of | {' | '.join(METRICS.values())} |")
    print("|---|" + "---:|" * len(METRICS))
    for label in columns[0]:
        print(f"| {label} | {' | '.join(column[label] for column in columns)} |")


if __name__ == "__main__":
    tyro.cli(main)
