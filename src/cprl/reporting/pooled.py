"""Runs of one experiment under several seeds, as one result of all their replicas."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from cprl.evaluation.evaluate import SEED
from cprl.reporting.measures import Measures, measures, of_training
from cprl.reporting.result import Result, Values
from cprl.runs.weights import lacks_weights
from cprl.studies.study import UNNAMED, Condition

_LONGEST_NAME: Final = 80
"""Of a pool; figures are named after it."""


@dataclass(kw_only=True, eq=False)
class PooledResult(Result):
    """Several runs of one experiment; what they are is told by the first."""

    parts: Sequence[Result]

    @property
    def name(self) -> str:
        """The names of the runs' directories, or that of the first and the number of others."""
        first, *others = (part.name for part in self.parts)
        whole = "+".join([first, *others])
        return whole if len(whole) <= _LONGEST_NAME else f"{first}+{len(others)} more"

    @cached_property
    def measures(self) -> Measures:
        """Measures of all trainings, and of agents at play where all runs have weights: each run's in worlds
        of its own, so that replicas are independent."""
        if any(lacks_weights(part.path) for part in self.parts):
            training = of_training(dict(self.curves), window=self.window)
            return Measures(training=training, trained={}, random={})
        each = [
            measures(part.path, window=self.window, seed=SEED + nth, allow=part.allow)
            for nth, part in enumerate(self.parts)
        ]
        return Measures(
            training=_joined([own.training for own in each]),
            trained=_joined([own.trained for own in each]),
            random=_joined([own.random for own in each]),
        )

    def of_agents(self, column: str) -> Values | None:
        """See `Result`."""
        each = [part.of_agents(column) for part in self.parts]
        known = [own for own in each if own is not None]
        return np.concatenate(known) if len(known) == len(each) else None

    def evaluated(self, policy: str) -> Mapping[str, Values] | None:
        """See `Result`."""
        each = [part.evaluated(policy) for part in self.parts]
        known = [own for own in each if own is not None]
        return _joined(known) if len(known) == len(each) else None


def pooled(results: Sequence[Result]) -> list[Result]:
    """Results of which those of one experiment are one, in the place of the first; others as they are.

    An experiment is one whatever its runs are called, but what repeats an experiment of the study is pooled
    only with what repeats it, too.

    Raises:
        ValueError: for two runs of one experiment with the same seed, whose replicas are the same.
    """
    groups: dict[tuple[str, int | None], list[Result]] = {}
    for result in results:
        number = None if result.study is None else result.study.number
        group = groups.setdefault((Condition(result.experiment).checksum, number), [])
        same = [other.path for other in group if other.experiment.seed == result.experiment.seed]
        if same:
            raise ValueError(
                f"runs has {same[0]} and {result.path}, of one experiment and both of seed "
                f"{result.experiment.seed}, which have the same replicas; allowed in a pool: each seed once"
            )
        group.append(result)
    return [group[0] if len(group) == 1 else _of(group) for group in groups.values()]


def _of(parts: Sequence[Result]) -> PooledResult:
    first = parts[0]
    return PooledResult(
        path=first.path,
        recipe=first.recipe,
        experiment=first.experiment,
        report=first.report,
        curves=_joined([part.curves for part in parts]),
        study=first.study,
        allow=first.allow,
        parts=parts,
    )


def told(results: Sequence[Result]) -> list[str]:
    """What is pooled, in a paragraph."""
    pools = [
        f"{' and '.join(part.name for part in own.parts)} as {own.name}"
        for own in results
        if isinstance(own, PooledResult)
    ]
    if pools:
        return [f"From here on these are one, as runs of one experiment: {'; '.join(pools)}.", ""]
    return [f"Nothing is pooled: no two runs have experiments equal but for {', '.join(UNNAMED)}.", ""]


def _joined(tables: Sequence[Mapping[str, Values]]) -> dict[str, Values]:
    """The names that all tables have, with the replicas of all."""
    names = [name for name in tables[0] if all(name in own for own in tables)]
    return {name: np.concatenate([own[name] for own in tables]) for name in names}
