"""Tables in Markdown."""

from collections.abc import Sequence
from typing import Final

_BAR: Final = "\\|"
"""What stands for a bar that does not end a cell."""


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """The lines of a table, followed by an empty line; a bar in a cell is escaped."""
    lines = [head, ["---"] * len(head), *rows]
    return [f"| {' | '.join(cell.replace('|', _BAR) for cell in cells)} |" for cells in lines] + [""]
