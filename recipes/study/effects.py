"""Main effects and interactions of the design of recipes/study/together.py, from the study's table.

    python recipes/study/effects.py studies/together

Prints a table in Markdown. An effect is the mean at the high level of a factor, or where the product of two
factors is high, minus the mean elsewhere, in each replica; intervals are of replicas, by Student's t. Stars
are what Holm's method leaves for all effects on one metric. Interactions that the design cannot tell apart
stand together.
"""

from collections import defaultdict
from itertools import combinations
from pathlib import Path
from typing import Annotated, Final

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq
import tyro
from numpy.typing import NDArray
from together import FACTORS, design, name

from cprl.measuring.statistics import Estimate, estimate, holm

LAST: Final = 30
"""Episodes at the end of each training."""
METRICS: Final = {"collective_return": "harvest after fines, apples", "survival_steps": "survival, turns"}


def measured(study: Path, metric: str) -> NDArray[np.float64]:
    """The mean of each replica over its last episodes, float [conditions, R], in the order of `design`."""
    table = pq.read_table(study / "table.parquet")
    table = table.filter((pc.field("part") == "training") & (pc.field("metric") == metric))
    first = max(table["episode"].to_pylist()) + 10 - LAST
    found: dict[tuple[str, int], list[float]] = defaultdict(list)
    for row in table.filter(pc.field("episode") >= first).to_pylist():
        found[row["condition"], row["replica"]].append(row["value"])
    replicas = sorted({replica for _, replica in found})
    return np.array([[np.mean(found[name(levels), r]) for r in replicas] for levels in design()])


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


def main(study: Annotated[Path, tyro.conf.Positional], /) -> None:
    """Print the effects.

    Args:
        study: the study's directory.
    """
    columns = []
    for metric in METRICS:
        found = effects(measured(study, metric))
        stars = holm([one.p_value for one in found.values()])
        columns.append(
            {k: f"{one:+}{'*' if star else ''}" for (k, one), star in zip(found.items(), stars, strict=True)}
        )
    print(f"| effect of | {' | '.join(METRICS.values())} |")
    print("|---|" + "---:|" * len(METRICS))
    for label in columns[0]:
        print(f"| {label} | {' | '.join(column[label] for column in columns)} |")


if __name__ == "__main__":
    tyro.cli(main)
