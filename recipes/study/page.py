"""What does a section of a page look like? A heading, a note and a table, in Markdown."""

from collections.abc import Sequence
from typing import Final

_BAR: Final = "\\|"
"""A bar that does not end a cell."""


def table(head: Sequence[str], rows: Sequence[Sequence[str]], *, numbers: int = 0) -> list[str]:
    """Return the lines of a table, followed by an empty one; a row that is too short ends in empty cells.

    Args:
        numbers: how many of the last columns are set to the right.
    """
    rules = ["---"] * (len(head) - numbers) + ["---:"] * numbers
    lines = []
    for row in (head, rules, *rows):
        cells = [cell.replace("|", _BAR) for cell in row]
        cells += [""] * (len(head) - len(cells))
        lines.append(f"| {' | '.join(cells)} |")
    return [*lines, ""]


def section(title: str, head: Sequence[str], rows: Sequence[Sequence[str]], note: str = "") -> list[str]:
    """Return the lines of a section; nothing without a row."""
    if not rows:
        return []
    return [f"## {title}", "", *([note, ""] if note else []), *table(head, rows)]
