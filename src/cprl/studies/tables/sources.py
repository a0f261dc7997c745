"""What a table is made of: runs, each with its condition and its replicas; and what is lacking."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from cprl.studies.naming import level_text, unlike
from cprl.studies.status import Status
from cprl.studies.study import Study
from cprl.studies.trials import State, trials_of

REASONS: Final[dict[State, str]] = {
    "missing": "was not begun",
    "unfinished": "has not ended",
    "finished": "is finished",
    "refused": "has another recipe than its name says, or none that can be read: was it renamed?",
}


@dataclass(frozen=True, kw_only=True)
class Source:
    """A run, and which replicas of which condition it holds."""

    run: Path
    name: str
    """What the run is called in the table."""
    condition: str
    checksum: str
    """See `cprl.studies.conditions.Condition`."""
    first: int
    """The number of its first replica in the table."""
    replicas: int
    episodes: int
    """That each replica trains."""


@dataclass(frozen=True, kw_only=True)
class Lacking:
    """A run that is not part of a table, and why."""

    name: str
    condition: str
    replicas: int
    reason: str

    def __str__(self) -> str:
        """In a sentence."""
        replicas = f"{self.replicas} replica{'s' * (self.replicas != 1)}"
        return f"{self.condition}: {self.name}, {replicas}, {self.reason}."


@dataclass(frozen=True, kw_only=True)
class Design:
    """The conditions that a table compares."""

    name: str
    conditions: Mapping[str, Mapping[str, Any]]
    """The level of each factor by condition, in order: a number, a truth value or a text."""
    reference: str
    """The condition that others are compared with."""
    is_paired: bool
    """Whether replicas of the same number have the same seeds and worlds in each condition."""
    is_grid: bool = True
    """Whether levels are few and repeat; not so for random draws."""
    notes: tuple[str, ...] = field(default=())
    """Sentences on what is compared."""

    @property
    def factors(self) -> tuple[str, ...]:
        """The names of the factors; () where conditions have names alone."""
        first = next(iter(self.conditions.values()))
        return tuple(first)


def design_of(study: Study) -> Design:
    """The conditions of a study."""
    levels: dict[str, dict[int, Any]] = {name: {} for name in study.factors}
    for name, own in ((name, own) for own in study.all_conditions for name in study.factors):
        at = own.levels[name]
        if id(at) not in levels[name]:
            plain = plain_level(at)
            alike = set(levels[name].values())
            levels[name][id(at)] = unlike(plain, alike) if isinstance(plain, str) else plain
    return Design(
        name=study.name,
        conditions={
            own.name: {name: levels[name][id(own.levels[name])] for name in study.factors}
            for own in study.all_conditions
        },
        reference=study.reference_name,
        is_paired=True,
        is_grid=study.draws is None,
    )


def sources_of(study: Study, runs: Path, status: Path | None = None) -> tuple[list[Source], list[Lacking]]:
    """The finished runs of a study, and the others.

    Args:
        study: the study.
        runs: the directory of its runs.
        status: where its trials say why they failed, if it is there.
    """
    finished, lacking = [], []
    for trial in trials_of(study):
        state, of = trial.state(runs), trial.condition
        if state == "finished":
            source = Source(
                run=runs / trial.name,
                name=trial.name,
                condition=of.name,
                checksum=of.checksum,
                first=trial.block.first,
                replicas=trial.block.replicas,
                episodes=trial.experiment.episodes,
            )
            finished.append(source)
        else:
            failure = None if status is None else Status(status, trial.name).failure()
            reason = REASONS[state] if failure is None else f"failed: {failure}"
            lacking.append(
                Lacking(
                    name=trial.name,
                    condition=of.name,
                    replicas=trial.block.replicas,
                    reason=reason,
                )
            )
    return finished, lacking


def plain_level(value: Any) -> Any:
    """A level as a table holds it: a number or truth value as it is, else a text."""
    return value if isinstance(value, bool | int | float) else level_text(value)
