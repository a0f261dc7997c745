"""Condition: one experiment of a study, and the checksum that names its runs."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final

from cprl.differences import without_defaults
from cprl.experiment import Experiment

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
