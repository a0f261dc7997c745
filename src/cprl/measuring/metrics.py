"""The names, words and units of metrics, and what is left out where a game does not report an entry.

Every game reports rewards and how episodes end. It may lack the entries of `OPTIONAL`. The entries that each
number needs are named in `cprl.measuring.social.SOCIAL` for metrics, and here for the other fields of an
`Episode`. A number whose entries a game lacks is left out; it is never zero or NaN instead.
"""

from collections.abc import Collection, Mapping
from math import inf
from typing import Any, Final

from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from cprl import keys
from cprl.commons.colours import APPLE, BLUE, GREEN, GREY, ORANGE, PALETTE, PURPLE, VERMILION, Colour
from cprl.measuring import institutions, social

NAMES: Final[Mapping[str, tuple[str, str]]] = {
    **{name: metric[:2] for name, metric in social.SOCIAL.items()},
    "stock_left": ("stock left at the end", "apples"),
    **{f"institutions/{name}": metric[:2] for name, metric in institutions.METRICS.items()},
}
"""The words and the unit of each number of an episode."""
COLOURS: Final[Mapping[str, Colour]] = {
    "collective_return": ORANGE,
    "efficiency": ORANGE,
    "equality": BLUE,
    "sustainability": GREEN,
    "survival_steps": (230, 120, 0),
    "peace": PURPLE,
    "peacefulness": PURPLE,
    "yield_share": GREEN,
    "stock_left": PALETTE[APPLE],
    "institutions/violations": VERMILION,
    "institutions/violations_per_step": VERMILION,
    "institutions/own_share_of_bites": GREEN,
    "institutions/detection_rate": ORANGE,
    "institutions/recidivism": PURPLE,
    "institutions/unjust_share_of_tags": BLUE,
    "institutions/net_equality": BLUE,
    "institutions/net_equality_within": GREEN,
    "institutions/net_equality_between": ORANGE,
}
"""The colours of lines, of which those that share a plot differ; all others have a grey."""
DIGITS: Final = {
    **{name: metric.digits for name, metric in social.SOCIAL.items() if metric.digits is not None},
    "stock_left": 1,
}
"""The digits behind the point of each metric in the summary of a run."""


def is_own(name: str) -> bool:
    """Whether a number of an episode is a metric of the user's own."""
    return not (name in NAMES or "/" in name or name == "net" or name.startswith("return_"))


def title(name: str) -> str:
    """Words and unit of a metric, e.g. "survival, steps"; the name itself if it is none."""
    return ", ".join(NAMES[name]) if name in NAMES else name


def colour(name: str) -> Colour:
    """The colour of a metric's lines."""
    return COLOURS.get(name, ORANGE if is_own(name) else GREY)


def unit(name: str) -> str:
    """The unit after a value, e.g. "steps"; "" where a range stands for one. A single agent's return is in
    apples."""
    word = "apples" if name.startswith("return_") else NAMES.get(name, ("", ""))[1]
    return "" if word == social.SHARE else word


def with_unit(name: str, *, rewards: str = "") -> str:
    """What a table calls a metric, with its unit, e.g. "survival, steps" or "agent 0: return, apples".

    Args:
        name: of a metric, or of what an agent gets or pays: ".../return", ".../fines", ".../transfers".
        rewards: the unit of rewards; "" if the game does not say.
    """
    if name in NAMES:
        return title(name)
    who, slash, what = name.rpartition("/")
    if who == "institutions":
        return f"in force: decision {what.removeprefix('in_force_')}"
    unit_of = rewards if what in ("return", "fines", "transfers") else ""
    return ", ".join(filter(None, (f"{who.replace('_', ' ')}: {what}" if slash else name, unit_of)))


def bounds(name: str, clock: float = inf) -> tuple[float, float]:
    """Return what a metric can be, as far as that is known; of a return, anything.

    Args:
        clock: the steps of the longest episode that the game allows.
    """
    is_share = name in NAMES and NAMES[name][1] == social.SHARE
    is_amount = name in NAMES or name.endswith(("/fines", "/transfers", "/violations"))
    is_time = name in ("sustainability", "survival_steps", "peacefulness")
    return 0.0 if is_amount else -inf, 1.0 if is_share else clock if is_time else inf


OPTIONAL: Final = ("harvest", "in_play", "fired", "hit_by", "tagged_by", "stock")
"""The optional entries, by the last part of their keys in `cprl.keys`; all but "stock" are in "agents"."""

METRICS: Final[Mapping[str, tuple[str, ...]]] = {name: social.SOCIAL[name].needs for name in social.METRICS}
"""The entries that each metric of an episode needs."""

FIELDS: Final[Mapping[str, tuple[str, ...]]] = {
    **{"harvest": ("harvest",), "in_play_steps": ("in_play",), "shots": ("fired",), "hits": ("hit_by",)},
    **dict.fromkeys(("tagged", "tagged_by"), ("tagged_by",)),
    **dict.fromkeys(("stock_left", "depletion_step"), ("stock",)),
}
"""The entries that each field of `Episode` needs; other fields need none."""

INSTITUTIONAL: Final[Mapping[str, str]] = {
    "fines": "fines",
    "transfers": "transfers",
    "violations": "violated",
    "counts": "counts",
    "in_force": "in_force",
}
"""The entry that each field of `Episode` about institutions needs."""
OF_INSTITUTIONS: Final = tuple(INSTITUTIONAL.values())
"""These entries; all but "in_force" are in "agents". A game without institutions has none of them and lacks
nothing."""


def reported_by(env: EnvBase) -> tuple[str, ...]:
    """The entries of `OPTIONAL` and `OF_INSTITUTIONS` in the specs of an environment, transforms included."""
    entries = set(env.observation_spec.keys(include_nested=True))
    return tuple(name for name in (*OPTIONAL, *OF_INSTITUTIONS) if {name, (keys.AGENTS, name)} & entries)


PLACES: Final[Mapping[str, Any]] = {
    **{name: ("next", keys.AGENTS, name) for name in (*OPTIONAL, *OF_INSTITUTIONS)},
    "in_play": keys.IN_PLAY,
    "stock": ("next", keys.STOCK),
    "in_force": ("next", keys.IN_FORCE),
}
"""The keys of these entries in a batch."""


def reported_in(tensordict: TensorDictBase) -> tuple[str, ...]:
    """The entries of `OPTIONAL` and `OF_INSTITUTIONS` in a batch."""
    return tuple(name for name, key in PLACES.items() if tensordict.get(key, None) is not None)


def available(needs: Mapping[str, tuple[str, ...]], reported: Collection[str]) -> tuple[str, ...]:
    """The names whose entries are all reported, in order."""
    return tuple(name for name, entries in needs.items() if set(entries) <= set(reported))


def left_out(reported: Collection[str], *, more: Mapping[str, tuple[str, ...]] | None = None) -> str:
    """One line of text with the numbers that are left out, and why; "" if there are none.

    Args:
        reported: the entries of `OPTIONAL` that the game reports.
        more: further names and the entries that they need; other words say what else the game lacks.
    """
    lacking: dict[str, list[str]] = {}
    for name, entries in {**METRICS, **FIELDS, **(more or {})}.items():
        missing = " and no ".join(entry for entry in entries if entry not in reported)
        if missing:
            lacking.setdefault(missing, []).append(name)
    parts = (f"{', '.join(names)} (the game reports no {missing})" for missing, names in lacking.items())
    text = "; ".join(parts)
    return f"left out: {text}" if text else ""
