"""What conditions and their levels are called, in names and on figures."""

from collections.abc import Iterable, Mapping
from typing import Any

from cprl.checks import shown


def named(levels: Mapping[str, Any]) -> str:
    """The name of a condition, e.g. "freeze_steps=5, gamma=0.9"."""
    return ", ".join(f"{name}={level_text(value)}" for name, value in levels.items())


def level_text(value: Any) -> str:
    """A level in a few words, for names and figures."""
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, tuple) and all(isinstance(own, int | float) for own in value):
        return f"({', '.join(map(level_text, value))})"
    return value if isinstance(value, str) else shown(value)


def short_names(factors: Iterable[str]) -> dict[str, str]:
    """The last word of each path, or the whole path where several factors share it."""
    last = {own: own.rpartition(".")[2] for own in factors}
    return {own: word if list(last.values()).count(word) == 1 else own for own, word in last.items()}
