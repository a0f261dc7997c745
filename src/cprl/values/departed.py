"""What values no longer have: fields and kinds that left, as earlier versions stored them."""

from collections.abc import Mapping
from typing import Any, Final

FIELDS: Final[dict[str, dict[str, Any]]] = {"DQNSettings": {"replay_transforms": []}}
"""Fields that left, by the kind that had them, with the value by which they did nothing."""
_OWN: Final = "an algorithm of your own; examples/own_algorithm/{}.py has it, to be copied into a module"
KINDS_THAT_LEFT: Final = {
    "DistributionalDQN": _OWN.format("c51"),
    "CQL": _OWN.format("cql"),
    "IQL": _OWN.format("iql"),
}
"""What kinds that left are now, in words."""


def without_departed(table: Any) -> Any:
    """Return a stored table without the fields that left, where they did nothing."""
    try:
        return _without(table)
    except RecursionError:
        raise ValueError("the table is nested too deeply") from None


def _without(table: Any) -> Any:
    if isinstance(table, list):
        return list(map(_without, table))
    if not isinstance(table, Mapping):
        return table
    left = FIELDS.get(str(table.get("kind")), {})
    kept = {name: entry for name, entry in table.items() if name not in left or entry != left[name]}
    return {name: _without(entry) for name, entry in kept.items()}
