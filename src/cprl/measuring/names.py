"""How people call the metrics, and their units."""

from typing import Final

SHARE: Final = "0 to 1"
NAMES: Final = {
    "collective_return": ("collective return", "apples"),
    "efficiency": ("efficiency", "apples per step"),
    "equality": ("equality (1 - Gini)", SHARE),
    "sustainability": ("sustainability (mean time of harvest)", "steps"),
    "survival_steps": ("survival", "steps"),
    "peace": ("peace (agents in play)", "agents"),
    "peacefulness": ("peacefulness", "steps in play per agent"),
    "stock_left": ("stock left at the end", "apples"),
    "yield_share": ("share of the map's yield", "ratio"),
}
"""The words and the unit of each metric of an episode."""


def title(name: str) -> str:
    """Words and unit of a metric, e.g. "survival, steps"; the name itself if it is none."""
    return ", ".join(NAMES[name]) if name in NAMES else name


def unit(name: str) -> str:
    """The unit after a value, e.g. "steps"; "" where a range stands for one. A single agent's return is in
    apples."""
    found = "apples" if name.startswith("return_") else NAMES.get(name, ("", ""))[1]
    return "" if found == SHARE else found


def with_unit(name: str, *, rewards: str = "") -> str:
    """The name of a metric in code with its unit, e.g. "survival_steps (steps)".

    Args:
        name: of a metric, or of a return: ".../return".
        rewards: the unit of rewards; "" if the game does not say.
    """
    own = rewards if name.endswith("/return") else NAMES.get(name, ("", ""))[1]
    return f"{name} ({own})" if own else name
