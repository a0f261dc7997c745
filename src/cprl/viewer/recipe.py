"""A recipe as a Markdown table: every value by its place, `agents.0.algorithm.settings.gamma`."""

from collections.abc import Iterator, Mapping
from typing import Any, Final

from cprl.checks import shown

_LONGEST: Final = 90
"""Characters of a value in the table; the recipe of the run has them all."""


def as_table(recipe: Mapping[Any, Any]) -> str:
    """The table; texts of several lines, such as drawn boards, stand below it as they are.

    An entry of a list that equals the first is one row that says so.
    """
    rows, texts = [], []
    for place, value in _places(recipe, ""):
        if isinstance(value, str) and "\n" in value:
            texts.append(f"`{place}`\n\n```\n{value}\n```")
        else:
            rows.append(f"| {_cell(place)} | {_cell(_short(value))} |")
    return "\n\n".join(["\n".join(["| place | value |", "| --- | --- |", *rows]), *texts])


def _places(value: Any, place: str) -> Iterator[tuple[str, Any]]:
    """Each value that holds no others, with its dotted place."""
    if isinstance(value, Mapping) and value:
        for name, own in value.items():
            yield from _places(own, f"{place}.{name}" if place else str(name))
    elif isinstance(value, list | tuple) and any(isinstance(own, Mapping) for own in value):
        for index, own in enumerate(value):
            if index and own == value[0]:
                yield f"{place}.{index}", f"as {place}.0"
            else:
                yield from _places(own, f"{place}.{index}")
    else:
        yield place, value


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else repr(value) if isinstance(value, float) else _plain(value)
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]} ..."


def _plain(value: Any) -> str:
    try:
        return str(value)
    except Exception:  # of whatever kind a user's object raises
        return shown(value)


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")
