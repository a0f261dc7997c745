"""How two tables of `cprl.config` differ, and what they hold besides defaults.

Stored recipes are compared with those of later versions, which know more fields.
"""

from collections.abc import Mapping
from dataclasses import MISSING, fields
from typing import Any, Final

from cprl.checks import shown
from cprl.config import KINDS, to_config

_ABSENT: Final = object()


def differences(before: object, now: object, where: str, kind: Any = None) -> list[str]:
    """How two tables differ, a sentence for each place.

    A field that the earlier one lacks, and that has its default in the later one, is no difference: a version
    that did not know the field did what its default says.

    Args:
        before: the earlier table.
        now: the later one.
        where: what they are of, in words.
        kind: the dataclass that they are of, where they do not say it themselves.
    """
    if isinstance(before, Mapping) and isinstance(now, Mapping):
        if before.get("kind") == now.get("kind"):
            return [
                line
                for name in {**before, **now}
                if not _is_default_of_later(name, before, now, kind)
                for line in differences(before.get(name, _ABSENT), now.get(name, _ABSENT), f"{where}.{name}")
            ]
    elif isinstance(before, list) and isinstance(now, list) and len(before) == len(now):
        pairs = enumerate(zip(before, now, strict=True))
        return [line for place, (a, b) in pairs for line in differences(a, b, f"{where}[{place}]")]
    return [] if before == now else [f"{where} was {_held(before)}, is {_held(now)}"]


def _is_default_of_later(
    name: str, before: Mapping[str, Any], now: Mapping[str, Any], kind: Any = None
) -> bool:
    """Whether a field is one of a later version, and says nothing that the earlier one did not do."""
    if before.get(name) is None and now.get(name) is None:
        return True
    kind = KINDS.get(str(now.get("kind"))) if kind is None else kind
    if name in before or kind is None:
        return False
    defaults = defaults_of(kind)
    return name in defaults and without_defaults(now[name]) == defaults[name]


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
    return {name: without_defaults(table) for name, table in tables.items()}


def without_defaults(table: Any, kind: Any = None) -> Any:
    """A table of `to_config` without the fields that have their default, and with 1.0 as 1."""
    if isinstance(table, list):
        return [without_defaults(own) for own in table]
    if isinstance(table, float) and table.is_integer():
        return int(table)
    if not isinstance(table, Mapping):
        return table
    if table.get("kind") == "Custom":
        return dict(table)
    kind = KINDS.get(str(table.get("kind"))) if kind is None else kind
    left_out = {} if kind is None else defaults_of(kind)
    plain = {name: without_defaults(own) for name, own in table.items()}
    return {name: own for name, own in plain.items() if name not in left_out or own != left_out[name]}


def _held(value: object) -> str:
    return "not there" if value is _ABSENT else shown(value)
