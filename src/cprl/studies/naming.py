"""What conditions and their levels are called, in names and on figures."""

from collections.abc import Container, Iterable, Mapping
from dataclasses import fields, is_dataclass
from itertools import chain, count
from typing import Any

from cprl.checks import shown

BETWEEN = ", "
"""Between the levels in the name of a condition."""


def named(levels: Mapping[str, Any]) -> str:
    """The name of a condition, e.g. "freeze_steps=5, gamma=0.9"."""
    return BETWEEN.join(f"{name}={level_text(value)}" for name, value in levels.items())


def unlike(name: str, taken: Container[str]) -> str:
    """A name; with the lowest number from 2 on that is free where it is taken."""
    numbered = (f"{name} #{nth}" for nth in count(2))
    return next(own for own in chain([name], numbered) if own not in taken)


def levels_in(name: str) -> list[str]:
    """The levels in the name of a condition; those of a tuple or an agent, in brackets, are not apart."""
    found: list[str] = []
    depth = 0
    for part in name.split(BETWEEN):
        if depth:
            found[-1] += BETWEEN + part
        else:
            found.append(part)
        depth = max(0, depth + sum((own in "([{") - (own in ")]}") for own in part))
    return found


def level_text(value: Any) -> str:
    """A level in a few words, for names and figures."""
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, tuple):
        return f"({', '.join(map(level_text, value))})"
    if is_dataclass(value) and not isinstance(value, type):
        return _value_text(value)
    return value if isinstance(value, str) else shown(value)


def _value_text(value: Any) -> str:
    """A dataclass by its class and its first field that is no switch, if that says more: "Learning(DQN)",
    "MLP((8, 8))"."""
    kind = type(value).__name__
    each = (getattr(value, own.name) for own in fields(value))
    first = next((own for own in each if not isinstance(own, bool)), "")
    inner = type(first).__name__ if is_dataclass(first) else level_text(first)
    says_no_more = first is None or not inner or inner.startswith(kind)  # as DQNSettings of DQN
    return kind if says_no_more else f"{kind}({inner})"


def short_names(factors: Iterable[str]) -> dict[str, str]:
    """The last word of each path, or the whole path where it is a number or several factors share it."""
    last = {own: own.rpartition(".")[2] for own in factors}
    shared = {word for word in last.values() if word.isdigit() or list(last.values()).count(word) > 1}
    return {own: own if word in shared else word for own, word in last.items()}
