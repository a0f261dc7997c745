"""Which effects do the factors of recipes/study/together.py have, alone and two together?

    python recipes/study/effects.py studies/together
    python recipes/study/effects.py studies/together --part evaluation

Prints a table in Markdown. An effect is the mean at the high level of a factor, or where the product of two
factors is high, minus the mean elsewhere, in each replica; intervals are of replicas, by Student's t. Stars
are what Holm's method leaves for all effects of one column. Interactions that the design cannot tell apart
stand together. Monitoring and sanctions are in the game only where a quota or boundaries are, in twelve of
the sixteen combinations: their effects here are not what they do there, see contrasts.py.
"""

from collections.abc import Iterable
from itertools import combinations
from pathlib import Path
from typing import Annotated, Final, Literal

import tyro
from page import table
from together import FACTORS, design, name

from cprl.measuring.statistics import CellWeights, Estimate, contrasts, crossed, main_effect, mean_difference
from cprl.studies import StudyTable

METRICS: Final = {"income": "income, apples", "survival_steps": "survival, turns"}


def effects() -> dict[str, CellWeights]:
    """Return what each condition counts in each effect: main effects, then groups of interactions of two
    factors."""
    signs = {}
    for factor in FACTORS:
        levels_of = {name(levels): levels[factor] for levels in design()}
        signs[factor] = main_effect(levels_of, True, False)
    groups: dict[tuple[float, ...], list[str]] = {}
    for one, other in combinations(FACTORS, 2):
        column = tuple(crossed(signs[one], signs[other]).values())
        groups.setdefault(column, []).append(f"{one} x {other}")
    for column, names in groups.items():
        signs[" = ".join(names)] = dict(zip(signs[FACTORS[0]], column, strict=True))
    return {label: mean_difference(column) for label, column in signs.items()}


def marked(differences: Iterable[Estimate]) -> list[str]:
    """Return texts with signs, and with stars where they differ by Holm's method."""
    return [f"{one:+}{'*' * one.differs}" for one in differences]


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
    rows = StudyTable.read(study / "table.parquet").windows(part)
    weights = effects()
    columns = [marked(contrasts(rows, metric, "condition", weights).values()) for metric in METRICS]
    lines = table(["effect of", *METRICS.values()], list(zip(weights, *columns, strict=True)), numbers=2)
    print("\n".join(lines[:-1]))


if __name__ == "__main__":
    tyro.cli(main)
