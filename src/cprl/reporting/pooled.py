"""Runs of one experiment under several seeds, as one result of all their replicas."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from cprl.reporting.measures import Measures
from cprl.reporting.result import Result, Values
from cprl.studies.conditions import Condition


@dataclass(kw_only=True, eq=False)
class PooledResult(Result):
    """Several runs that differ in nothing but name, seed and the number of replicas; what they are is told by
    the first.

    Where agents are measured at play, replica r of each plays the same fresh worlds, as those of two
    experiments do.
    """

    parts: Sequence[Result] = field(kw_only=True)

    @property
    def name(self) -> str:
        """The names of the runs' directories, joined by "+"."""
        return "+".join(part.name for part in self.parts)

    @cached_property
    def measures(self) -> Measures:
        """Measures of all trainings; those of agents at play where all runs have them."""
        each = [part.measures for part in self.parts]
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

    Raises:
        ValueError: for two runs of one experiment with the same seed, whose replicas are the same.
    """
    groups: dict[str, list[Result]] = {}
    for result in results:
        group = groups.setdefault(Condition(result.experiment).checksum, [])
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


def _joined(tables: Sequence[Mapping[str, Values]]) -> dict[str, Values]:
    """The names that all tables have, with the replicas of all."""
    names = [name for name in tables[0] if all(name in own for own in tables)]
    return {name: np.concatenate([own[name] for own in tables]) for name in names}
