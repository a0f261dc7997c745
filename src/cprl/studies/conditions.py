"""Condition: one experiment of a study, what its levels make of it, and the checksum that names its runs."""

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Final

from cprl.config import without_defaults
from cprl.experiment import Experiment
from cprl.studies.factors import Level
from cprl.studies.naming import unlike
from cprl.studies.paths import changed

FORMAT: Final = 1
"""Of checksums: counted up when a default of any value of `cprl.config.KINDS`, or of `Experiment`, changes,
so that the same checksum never means two things."""

UNNAMED: Final = ("name", "seed", "replicas", "on_nan")
"""Fields of an experiment that its checksum leaves out: what it is called, which repetitions of it a run
holds, and what happens where a number is not finite."""


@dataclass(frozen=True, eq=False)
class Condition:
    """One experiment of a study.

    Args:
        experiment: what is trained; its seed and replicas are those of the study.
        levels: the level of each factor, by factor: a value, or the name of a level.
        name: what it is called, unique in its study.
    """

    experiment: Experiment
    levels: Mapping[str, Any] = field(default_factory=dict)
    name: str = ""

    @cached_property
    def checksum(self) -> str:
        """Of all that decides its numbers but the seed: 12 hexadecimal digits.

        Fields that have their default are left out, so that a later version, which has further ones, gives
        the same.
        """
        table = {name: own for name, own in self.experiment.to_config().items() if name not in UNNAMED}
        kept = {"format": FORMAT, "experiment": without_defaults(table, Experiment)}
        return hashlib.blake2b(json.dumps(kept, sort_keys=True).encode(), digest_size=6).hexdigest()


def experiment_at(experiment: Experiment, levels: Mapping[str, Level]) -> Experiment:
    """An experiment with what a level of each factor changes.

    Raises:
        ValueError: for two factors that change the same field, for a field that the study itself decides,
            and for what does not fit, see `cprl.studies.paths.changed`.
    """
    changes = {path: value for own in levels.values() for path, value in own.changes.items()}
    twice = sum(len(own.changes) for own in levels.values()) - len(changes)
    if twice:
        raise ValueError(f"two factors change the same field, of {', '.join(changes)}; allowed: one each")
    refused = [path for path in changes if path in ("seed", "replicas", "name")]
    if refused:
        raise ValueError(f"a factor is {refused[0]}, which the study itself decides; allowed: other fields")
    return changed(experiment, changes) if changes else experiment


def apart(conditions: Iterable[Condition]) -> tuple[Condition, ...]:
    """Conditions with a number after their name where others have the same, e.g. of unlike agents."""
    conditions = tuple(conditions)
    taken = {own.name for own in conditions}
    found: dict[str, Condition] = {}
    for own in conditions:
        name = unlike(own.name, taken) if own.name in found else own.name
        taken.add(name)
        found[name] = own if name == own.name else replace(own, name=name)
    return tuple(found.values())
