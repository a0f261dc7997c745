"""The entries that a game may not report, and the numbers that are then left out, by name.

Every game reports rewards and how episodes end. It may lack the entries of `OPTIONAL`. The entries that each
number needs are named in `cprl.measuring.social.NEEDS` for metrics, and here for the other fields of an
`Episode`. A number whose entries a game lacks is left out; it is never zero or NaN instead.
"""

from collections.abc import Collection, Mapping
from types import MappingProxyType
from typing import Any, Final

from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from cprl import keys
from cprl.arguments import listed, object_of
from cprl.measuring import social

OPTIONAL: Final = ("harvest", "in_play", "fired", "hit_by", "tagged_by", "stock")
"""The optional entries, by the last part of their keys in `cprl.keys`; all but "stock" are in "agents"."""

OF_INSTITUTIONS: Final = ("fines", "transfers", "violated", "counts", "in_force")
"""The entries of games with institutions, likewise; all but "in_force" are in "agents". A game without
institutions has none of them and lacks nothing."""

METRICS: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {name: social.NEEDS[name] for name in social.METRICS}
)
"""The entries that each metric of an episode needs."""

FIELDS: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {
        "harvest": ("harvest",),
        "in_play_steps": ("in_play",),
        "shots": ("fired",),
        "hits": ("hit_by",),
        "tagged": ("tagged_by",),
        "tagged_by": ("tagged_by",),
        "stock_left": ("stock",),
        "depletion_step": ("stock",),
    }
)
"""The entries that each field of `Episode` needs; other fields need none."""

INSTITUTIONAL: Final[Mapping[str, str]] = MappingProxyType(
    {
        "fines": "fines",
        "transfers": "transfers",
        "violations": "violated",
        "counts": "counts",
        "in_force": "in_force",
    }
)
"""The entry of `OF_INSTITUTIONS` that each field of `Episode` about institutions needs."""


def reported_by(env: EnvBase) -> tuple[str, ...]:
    """The entries of `OPTIONAL` and `OF_INSTITUTIONS` in the specs of an environment, transforms included."""
    object_of("env", env, EnvBase, "a TorchRL environment")
    found = set(env.observation_spec.keys(include_nested=True))
    return tuple(name for name in (*OPTIONAL, *OF_INSTITUTIONS) if {name, (keys.AGENTS, name)} & found)


def reported_in(tensordict: TensorDictBase) -> tuple[str, ...]:
    """The entries of `OPTIONAL` and `OF_INSTITUTIONS` in a batch: in_play at the root, the others under
    "next"."""
    object_of("tensordict", tensordict, TensorDictBase, "a TensorDict")
    places: dict[str, Any] = {name: ("next", keys.AGENTS, name) for name in (*OPTIONAL, *OF_INSTITUTIONS)}
    places |= {"in_play": keys.IN_PLAY, "stock": ("next", keys.STOCK), "in_force": ("next", keys.IN_FORCE)}
    return tuple(name for name, place in places.items() if tensordict.get(place, None) is not None)


def available(needs: Mapping[str, tuple[str, ...]], reported: Collection[str]) -> tuple[str, ...]:
    """The names whose entries are all reported, in order.

    Args:
        needs: the entries by name, e.g. `FIELDS`.
        reported: the entries of `OPTIONAL` that the game reports.
    """
    object_of("needs", needs, Mapping, "the entries by name, e.g. FIELDS")
    reported = listed("reported", reported, "names of entries")
    return tuple(name for name, entries in needs.items() if set(entries) <= set(reported))


def left_out(reported: Collection[str], *, more: Mapping[str, tuple[str, ...]] | None = None) -> str:
    """One line of text with the numbers that are left out, and why; "" if there are none.

    Args:
        reported: the entries of `OPTIONAL` that the game reports.
        more: further names and the entries that they need; other words say what else the game lacks.
    """
    reported = listed("reported", reported, "names of entries")
    lacking: dict[str, list[str]] = {}
    for name, entries in {**METRICS, **FIELDS, **(more or {})}.items():
        missing = " and no ".join(entry for entry in entries if entry not in reported)
        if missing:
            lacking.setdefault(missing, []).append(name)
    parts = (f"{', '.join(names)} (the game reports no {missing})" for missing, names in lacking.items())
    text = "; ".join(parts)
    return f"left out: {text}" if text else ""
