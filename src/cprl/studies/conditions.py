"""Condition: one experiment of a study, and the checksum that names its runs."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields
from functools import cached_property
from typing import Any, Final

from cprl.config import KINDS, to_config
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
        kept = {"format": FORMAT, "experiment": _without_defaults(table, Experiment)}
        return hashlib.blake2b(json.dumps(kept, sort_keys=True).encode(), digest_size=6).hexdigest()


def defaults_of(kind: Any) -> dict[str, Any]:
    """The defaults of the fields of a dataclass as a recipe holds them; those without one are left out."""
    found = {}
    for own in fields(kind):
        if own.init and own.default is not MISSING:
            found[own.name] = own.default
        elif own.init and own.default_factory is not MISSING:
            found[own.name] = own.default_factory()
    tables = {  # the arguments of a Custom are a table already
        name: value if isinstance(value, Mapping) else to_config(value) for name, value in found.items()
    }
    return {name: _without_defaults(table) for name, table in tables.items()}


def _without_defaults(table: Any, kind: Any = None) -> Any:
    """A table of `to_config` without the fields that have their default, and with 1.0 as 1."""
    if isinstance(table, list):
        return [_without_defaults(own) for own in table]
    if isinstance(table, float) and table.is_integer():
        return int(table)
    if not isinstance(table, Mapping):
        return table
    if table.get("kind") == "Custom":
        return dict(table)
    kind = KINDS.get(str(table.get("kind"))) if kind is None else kind
    left_out = {} if kind is None else defaults_of(kind)
    plain = {name: _without_defaults(own) for name, own in table.items()}
    return {name: own for name, own in plain.items() if name not in left_out or own != left_out[name]}
