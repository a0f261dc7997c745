"""Tables of texts and estimates: for the terminal, whose width they fit, for Markdown, LaTeX and CSV.

table = Cells("Means over replicas.", ["condition", "equality"], [["vote", Estimate(...)]])
show([table])
write([table], "means.tex")
"""

import csv
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from textwrap import TextWrapper
from typing import TYPE_CHECKING, Final, NamedTuple, Union

from rich.console import Console, ConsoleOptions, RenderableType
from rich.table import Table
from rich.text import Text

from cprl.runs.files import refuse_to_write_over, write_atomically
from cprl.system.output import OUT, console
from cprl.values import refusal

if TYPE_CHECKING:
    from cprl.measuring.statistics import Estimate

_FILE_WIDTH: Final = 250
"""Of tables in a file or pipe, in characters."""
_LATEX: Final = str.maketrans(
    {
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "<": r"\textless{}",
        ">": r"\textgreater{}",
        "|": r"\textbar{}",
        **{sign: f"\\{sign}" for sign in "&%$#_{}"},
    }
)


@dataclass(frozen=True)
class Change:
    """A difference as a cell: with its sign, and bold where it `differs`."""

    estimate: "Estimate"
    more: str = ""
    """What follows it, e.g. "(of 2)"."""

    def __str__(self) -> str:
        return " ".join(filter(None, (f"{self.estimate:+}", self.more)))


Cell = Union[str, "Estimate", Change]
"""A text that has no signs of its own, a number with its interval, or a difference."""


class Cells(NamedTuple):
    """A table. In the terminal its names wrap and its intervals go to a second line where it is too
    narrow for them; columns that still have no room follow in further tables."""

    heading: str
    """What it shows, in a sentence."""
    head: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    note: str = ""
    """What its signs mean, below it."""
    texts: int = 1
    """How many of the first columns are names; the others are numbers."""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[RenderableType]:
        yield Text(self.heading, style="bold")
        room = options.max_width
        texts = [[_marked(cell, "{} *") for cell in row] for row in self.rows]
        rows = texts
        widths = [max(_longest(head), wide) for head, wide in zip(self.head, self._widths(rows), strict=True)]
        if _total(widths) > room:
            widths = self._widths(rows)
        for name in (room // 2, room // 3, room // 4):
            if _total(widths) > room:
                rows = [
                    [lines_of(text, name) for text in row[: self.texts]] + _narrow(row[self.texts :])
                    for row in texts
                ]
                widths = self._widths(rows)
        for columns in _blocks(widths, self.texts, room):
            table = Table()
            for column in columns:
                head = lines_of(self.head[column], widths[column])
                table.add_column(head, justify="left" if column < self.texts else "right", overflow="fold")
            for row, cells in zip(rows, self.rows, strict=True):
                styles = ("bold" if _is_bold(cells[column]) else "" for column in columns)
                table.add_row(*map(Text, (row[column] for column in columns), styles))
            yield table
        if self.note:
            yield Text(self.note.replace("Bold:", "*"), style="italic")

    def _widths(self, rows: Sequence[Sequence[str]]) -> list[int]:
        """Return the widths of the columns, whose heads wrap."""
        widths = []
        for column, head in enumerate(self.head):
            word = max([min(len(head), 9), *map(len, head.split())])
            widths.append(max([min(word, 18), *(_longest(row[column]) for row in rows)]))
        return widths


def show(tables: Iterable[RenderableType]) -> None:
    """Print tables and texts; into a file or pipe as wide as they are, or as COLUMNS says."""
    terminal = console(width=None if OUT.isatty() or "COLUMNS" in os.environ else _FILE_WIDTH)
    for table in tables:
        terminal.print(table)


def write(tables: Sequence[Cells], path: str | Path, *, notes: Sequence[str] = ()) -> Path:
    """Write tables into a new file: as text, Markdown, LaTeX or CSV, by the suffix of its name.

    Args:
        notes: lines below all tables, which a CSV does not have.
    """
    path = Path(path)
    if path.suffix not in SUFFIXES:
        raise refusal("path", str(path), f"a file whose name ends in {', '.join(SUFFIXES)}")
    refuse_to_write_over(path)
    content = SUFFIXES[path.suffix](tables, notes).encode()
    path.parent.mkdir(parents=True, exist_ok=True)
    return write_atomically(path, lambda file: file.write(content))


def markdown(table: Cells) -> list[str]:
    """Return the lines of a table, numbers to the right, each part followed by an empty line."""
    rows = [[*map(cell, table.head)], *(list(map(_in_markdown, row)) for row in table.rows)]
    lines = [f"| {' | '.join(row)} |" for row in rows]
    lines.insert(1, "|---|" + "---:|" * (len(table.head) - 1))
    return [*lines, "", *[table.note, ""] * bool(table.note)]


def cell(name: str) -> str:
    """Return a name of a user's as a cell of a table in Markdown, in which its signs mean nothing."""
    return re.sub(r"[\\`*<$|]", r"\\\g<0>", " ".join(name.splitlines()))


def _as_text(tables: Sequence[Cells], notes: Sequence[str]) -> str:
    drawn = StringIO()
    plain = Console(
        file=drawn, width=_FILE_WIDTH, force_terminal=False, force_jupyter=False, color_system=None
    )
    plain.print(*tables, *map(Text, notes), sep="\n")
    return drawn.getvalue()


def _as_markdown(tables: Sequence[Cells], notes: Sequence[str]) -> str:
    lines = [line for table in tables for line in (table.heading, "", *markdown(table))]
    return "\n".join([*lines, *notes, ""])


def _as_latex(tables: Sequence[Cells], notes: Sequence[str]) -> str:
    lines = [r"% \usepackage{booktabs}"]
    for table in tables:
        head, *rows = (" & ".join(map(_in_latex, row)) + r" \\" for row in (table.head, *table.rows))
        columns = "l" * max(table.texts, 1)
        columns = columns.ljust(len(table.head), "r")
        lines += [
            r"\begin{table}",
            rf"\caption{{{_in_latex(table.heading)}}}",
            rf"\begin{{tabular}}{{{columns}}}",
            *(r"\toprule", head, r"\midrule", *rows, r"\bottomrule"),
            r"\end{tabular}",
            *(rf"\par\smallskip\footnotesize {_in_latex(line)}" for line in table.note.splitlines()),
            r"\end{table}",
        ]
    return "\n".join([*lines, *map(_in_latex, notes), ""])


def _as_csv(tables: Sequence[Cells], notes: Sequence[str]) -> str:
    """Return a row for each cell: "table" (its heading), "row" (its names), "column"; of an estimate its
    numbers, of another cell its "text"."""
    from cprl.measuring.statistics import NUMBERS, numbers_of

    written = StringIO(newline="")
    writer = csv.DictWriter(written, ["table", "row", "column", *NUMBERS, "text"], lineterminator="\n")
    writer.writeheader()
    for table in tables:
        names = max(table.texts, 1)
        for row in table.rows:
            place = {"table": " ".join(table.heading.split()), "row": ", ".join(map(str, row[:names]))}
            for head, part in zip(table.head[names:], row[names:], strict=True):
                one = part.estimate if isinstance(part, Change) else part
                numbers = {"text": one} if isinstance(one, str) else numbers_of(one)
                for name in ("episodes", "undefined") if isinstance(part, Change) else ("p_value", "differs"):
                    numbers.pop(name, None)  # nobody counted them, or tested whether a level is 0
                writer.writerow({**place, "column": head, **numbers})
    return written.getvalue()


SUFFIXES: Final = {".txt": _as_text, ".md": _as_markdown, ".tex": _as_latex, ".csv": _as_csv}
"""How `write` writes a file, by the suffix of its name."""


def _is_bold(part: Cell) -> bool:
    return isinstance(part, Change) and part.estimate.differs


def _marked(part: Cell, mark: str) -> str:
    """Return the text of a cell, with its number where a mark has {} if it is bold."""
    if isinstance(part, Change) and _is_bold(part):
        return str(part).replace(f"{part.estimate:+}", mark.format(f"{part.estimate:+}"), 1)
    return str(part)


def _in_markdown(part: Cell) -> str:
    return cell(part) if isinstance(part, str) else _marked(part, "**{}**")


def _in_latex(part: Cell) -> str:
    if isinstance(part, str):
        return " ".join(part.split()).translate(_LATEX)
    return re.sub(r"-(?=[\d.])", "$-$", _marked(part, r"\textbf{{{}}}"))


class _Wrapper(TextWrapper):
    """Breaks lines after the signs that join the words of a name, too."""

    wordsep_re = re.compile(r"(\s+|(?<=[_/,=-])(?=\w))")


def lines_of(text: str, most: int) -> str:
    """Return a text in lines of so many characters, broken within names that are longer than that."""
    has_long = any(len(word) > most for word in text.split())
    fill = (_Wrapper if has_long else TextWrapper)(most, break_long_words=False).fill
    return "\n".join(fill(line) for line in text.splitlines())


def _total(widths: Sequence[int]) -> int:
    return sum(widths) + 3 * len(widths) + 1


def _blocks(widths: Sequence[int], texts: int, room: int) -> Iterator[list[int]]:
    """Yield the columns of each table, all of which begin with the names."""
    names = list(range(texts))
    block = list(names)
    for column in range(texts, len(widths)):
        if len(block) > texts and _total([widths[place] for place in (*block, column)]) > room:
            yield block
            block = list(names)
        block.append(column)
    yield block


def _longest(text: str) -> int:
    return max(map(len, text.splitlines()), default=0)


def _narrow(numbers: Sequence[str]) -> list[str]:
    """Return numbers with their intervals below them, and below these in how many episodes they are
    undefined."""
    return [re.sub(r",? ?(\[|undefined in)", r"\n\1", text).lstrip("\n") for text in numbers]
