"""Tables of texts for the terminal, which fit its width, and for Markdown."""

import os
import re
from collections.abc import Iterable, Iterator, Sequence
from textwrap import TextWrapper
from typing import NamedTuple

from rich.console import Console, ConsoleOptions, RenderableType
from rich.table import Table
from rich.text import Text

from cprl.system.output import OUT, console


class Cells(NamedTuple):
    """A table of texts. In the terminal its names wrap and its intervals go to a second line where it is
    too narrow for them; columns that still have no room follow in further tables."""

    heading: str
    """What it shows, in a sentence."""
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""
    """What its signs mean, below it."""
    texts: int = 1
    """How many of the first columns are names; the others are numbers."""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[RenderableType]:
        yield Text(self.heading, style="bold")
        room, rows = options.max_width, [list(row) for row in self.rows]
        widths = [max(_longest(head), wide) for head, wide in zip(self.head, self._widths(rows), strict=True)]
        if _total(widths) > room:
            widths = self._widths(rows)
        for name in (room // 2, room // 3, room // 4):
            if _total(widths) > room:
                rows = [
                    [lines_of(text, name) for text in row[: self.texts]] + _narrow(row[self.texts :])
                    for row in self.rows
                ]
                widths = self._widths(rows)
        for columns in _blocks(widths, self.texts, room):
            table = Table()
            for column in columns:
                head = lines_of(self.head[column], widths[column])
                table.add_column(head, justify="left" if column < self.texts else "right", overflow="fold")
            for row in rows:
                table.add_row(*(_bold(row[column]) for column in columns))
            yield table
        if self.note:
            yield Text(self.note.replace("Bold:", "*"), style="italic")

    def _widths(self, rows: Sequence[Sequence[str]]) -> list[int]:
        """Of the columns, whose heads wrap."""
        widths = []
        for column, head in enumerate(self.head):
            word = max([min(len(head), 9), *map(len, head.split())])
            widths.append(max([min(word, 18), *(_longest(row[column]) for row in rows)]))
        return widths


def show(tables: Iterable[RenderableType]) -> None:
    """Print tables and texts; into a file or pipe as wide as they are, or as COLUMNS says."""
    terminal = console(width=None if OUT.isatty() or "COLUMNS" in os.environ else 250)
    for table in tables:
        terminal.print(table)


def markdown(table: Cells) -> list[str]:
    """Return the lines of a table, numbers to the right, each part followed by an empty line."""
    rows = [[*map(cell, table.head)], *([cell(name), *texts] for name, *texts in table.rows)]
    lines = [f"| {' | '.join(row)} |" for row in rows]
    lines.insert(1, "|---|" + "---:|" * (len(table.head) - 1))
    return [*lines, "", *[table.note, ""] * bool(table.note)]


def cell(name: str) -> str:
    """Return a name of a user's as a cell of a table in Markdown, in which its signs mean nothing."""
    return re.sub(r"[\\`*<$|]", r"\\\g<0>", " ".join(name.splitlines()))


class _Wrapper(TextWrapper):
    """Breaks lines after the signs that join the words of a name, too."""

    wordsep_re = re.compile(r"(\s+|(?<=[_/,=-])(?=\w))")


def lines_of(text: str, most: int) -> str:
    """A text in lines of so many characters, broken within names only where they are longer than that."""
    has_long = any(len(word) > most for word in text.split())
    fill = (_Wrapper if has_long else TextWrapper)(most, break_long_words=False).fill
    return "\n".join(fill(line) for line in text.splitlines())


def _total(widths: Sequence[int]) -> int:
    return sum(widths) + 3 * len(widths) + 1


def _blocks(widths: Sequence[int], texts: int, room: int) -> Iterator[list[int]]:
    """The columns of each table, all of which begin with the names."""
    names = list(range(texts))
    block = list(names)
    for column in range(texts, len(widths)):
        if len(block) > texts and _total([widths[place] for place in (*block, column)]) > room:
            yield block
            block = list(names)
        block.append(column)
    yield block


def _longest(text: str) -> int:
    return max(map(len, _bold(text).plain.splitlines()), default=0)


def _narrow(numbers: Sequence[str]) -> list[str]:
    """Numbers with their intervals below them, and below these in how many episodes they are undefined."""
    return [re.sub(r",? ?(\[|undefined in)", r"\n\1", text).lstrip("\n") for text in numbers]


def _bold(text: str) -> Text:
    """The text of a cell; what is bold in Markdown has a star too."""
    bold, mark, more = text.removeprefix("**").partition("**")
    return Text(f"{bold} *{more}", style="bold") if mark and text.startswith("**") else Text(text)
