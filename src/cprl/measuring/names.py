"""How people call the metrics, and their units."""

from typing import Final

SHARE: Final = "0 to 1"
NAMES: Final = {
    "collective_return": ("collective return", "apples"),
    "efficiency": ("efficiency", "apples per step"),
    "equality": ("equality (1 - Gini)", SHARE),
    "sustainability": ("sustainability", "steps"),
    "survival_steps": ("survival", "steps"),
    "peace": ("peace", "agents"),
    "peacefulness": ("peacefulness", "steps in play per agent"),
    "stock_left": ("stock left at the end", "apples"),
    "yield_share": ("yield share of the steps played", "ratio"),
}
"""The words and the unit of each metric of an episode."""
OF_INSTITUTIONS: Final = {
    "fines": ("fines of all", "apples"),
    "transfers": ("transfers to all", "apples"),
    "violations": ("violations", "turns"),
    "violations_per_step": ("violations per turn in play", SHARE),
    "trespasses": ("trespasses", "turns"),
    "excess_bites": ("taken above a quota", "bites"),
    "closed_bites": ("taken in closed seasons and patches", "bites"),
    "own_share_of_bites": ("bites where one may bite", SHARE),
    "detection_rate": ("violations detected", SHARE),
    "recidivism": ("violations after a sanction", SHARE),
    "sanctions_per_violation": ("sanctions per violation", "ratio"),
    "unjust_share_of_tags": ("unjust tags", SHARE),
    "net_equality": ("equality of net incomes", SHARE),
    "equality_within": ("equality within groups", SHARE),
    "equality_between": ("equality between groups", SHARE),
    "net_equality_within": ("equality of net incomes within groups", SHARE),
    "net_equality_between": ("equality of net incomes between groups", SHARE),
}
"""The same of the metrics of institutions, without the prefix `institutions/`."""
_WORDS: Final = {**NAMES, **{f"institutions/{name}": words for name, words in OF_INSTITUTIONS.items()}}


def title(name: str) -> str:
    """Words and unit of a metric, e.g. "survival, steps"; the name itself if it is none."""
    return ", ".join(_WORDS[name]) if name in _WORDS else name


def unit(name: str) -> str:
    """The unit after a value, e.g. "steps"; "" where a range stands for one. A single agent's return is in
    apples."""
    found = "apples" if name.startswith("return_") else _WORDS.get(name, ("", ""))[1]
    return "" if found == SHARE else found


def with_unit(name: str, *, rewards: str = "") -> str:
    """The name of a metric in code with its unit, e.g. "survival_steps (steps)".

    Args:
        name: of a metric, or of what an agent gets or pays: ".../return", ".../fines", ".../transfers".
        rewards: the unit of rewards; "" if the game does not say.
    """
    own = rewards if name.endswith(("/return", "/fines", "/transfers")) else _WORDS.get(name, ("", ""))[1]
    return f"{name} ({own})" if own else name
