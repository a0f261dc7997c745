"""Tables of texts and estimates, for the terminal, whose width they fit, and as Markdown, LaTeX and CSV.

table = TextTable("Means over replicas.", ["condition", "equality"], [["vote", Estimate(...)]])
print_tables([table])
write_tables([table], "means.tex")
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

from rich.console import Console, ConsoleOptions, JustifyMethod, RenderableType
from rich.table import Table
from rich.text import Text

from cprl.runs.files import refuse_to_write_over, write_text
from cprl.system.output import OUT, console
from cprl.values import refusal

if TYPE_CHECKING:
    from cprl.measuring.statistics import Estimate

_FILE_WIDTH: Final = 250
"""The width of tables in a file or pipe, in characters."""
_LATEX_ESCAPES: Final = str.maketrans(
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
    """A difference as a cell: it has its sign, and is bold if it `differs` from 0."""

    estimate: "Estimate"
    more: str = ""
    """The text after the number, e.g. "(of 2)"."""

    def __str__(self) -> str:
        return self.marked("{}")

    def marked(self, template: str) -> str:
        """Return the text; if the difference is not 0, its number is put into a template such as "{} *"."""
        number = f"{self.estimate:+}"
        if self.estimate.differs:
            number = template.format(number)
        return " ".join(filter(None, (number, self.more)))


TableCell = Union[str, "Estimate", Change]
"""A text, a number with its interval, or a difference."""


class TextTable(NamedTuple):
    """A table with a heading and a note.

    In a narrow terminal names are wrapped and intervals go to a second line. Columns that still do not fit
    follow in further tables, which begin with the names again.
    """

    heading: str
    """The sentence above the table."""
    head: Sequence[str]
    """The names of the columns."""
    rows: Sequence[Sequence[TableCell]]
    note: str = ""
    """The text below the table, e.g. the meaning of its signs."""
    texts: int = 1
    """The number of columns with names, which come first; the other columns hold numbers."""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[RenderableType]:
        yield Text(self.heading, style="bold")
        rows, widths = self._fit(options.max_width)
        for columns in _column_blocks(widths, self.texts, options.max_width):
            yield self._rich_table(rows, widths, columns)
        if self.note:
            yield Text(self.note.replace("Bold:", "*"), style="italic")

    def _fit(self, room: int) -> tuple[list[list[str]], list[int]]:
        """Return the texts of all rows and the widths of the columns, wrapped as far as the room asks for."""
        rows = self._texts()
        widths = self._widths(rows)
        unwrapped = [max(_longest(head), width) for head, width in zip(self.head, widths, strict=True)]
        if _total(unwrapped) <= room:
            return rows, unwrapped
        for name_width in (room // 2, room // 3, room // 4):
            if _total(widths) > room:
                rows = self._narrow_texts(name_width)
                widths = self._widths(rows)
        return rows, widths

    def _rich_table(
        self, rows: Sequence[Sequence[str]], widths: Sequence[int], columns: Sequence[int]
    ) -> Table:
        """Return the table of some columns for the terminal."""
        table = Table()
        for column in columns:
            head = wrap_lines(self.head[column], widths[column])
            side: JustifyMethod = "left" if column < self.texts else "right"
            table.add_column(head, justify=side, overflow="fold")
        for row, cells in zip(rows, self.rows, strict=True):
            styles = ("bold" if _is_bold(cells[column]) else "" for column in columns)
            table.add_row(*map(Text, (row[column] for column in columns), styles))
        return table

    def _texts(self) -> list[list[str]]:
        """Return the texts of all cells, with a star for bold ones."""
        return [list(map(_marked_by_star, row)) for row in self.rows]

    def _narrow_texts(self, name_width: int) -> list[list[str]]:
        """Return the rows with wrapped names, and with intervals on a second line."""
        rows = []
        for row in self._texts():
            names = [wrap_lines(text, name_width) for text in row[: self.texts]]
            rows.append([*names, *map(_interval_below, row[self.texts :])])
        return rows

    def _widths(self, rows: Sequence[Sequence[str]]) -> list[int]:
        """Return the widths of the columns with wrapped heads."""
        widths = []
        for column, head in enumerate(self.head):
            longest_word = max([min(len(head), 9), *map(len, head.split())])
            widths.append(max([min(longest_word, 18), *(_longest(row[column]) for row in rows)]))
        return widths


def print_tables(tables: Iterable[RenderableType]) -> None:
    """Print tables and texts; into a file or pipe without wrapping, unless COLUMNS sets a width."""
    width = None if OUT.isatty() or "COLUMNS" in os.environ else _FILE_WIDTH
    terminal = console(width=width)
    for table in tables:
        terminal.print(table)


def write_tables(tables: Sequence[TextTable], path: str | Path, *, notes: Sequence[str] = ()) -> Path:
    """Write tables into a new file as text, Markdown, LaTeX or CSV; the suffix of its name decides.

    Args:
        notes: lines below all tables; a CSV has none.

    Raises:
        ValueError: for another suffix.
        FileExistsError: if the file exists.
    """
    path = Path(path)
    if path.suffix not in WRITERS:
        raise refusal("path", str(path), f"a file whose name ends in {', '.join(WRITERS)}")
    refuse_to_write_over(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    return write_text(path, WRITERS[path.suffix](tables, notes))


def markdown(table: TextTable) -> list[str]:
    """Return the lines of a table in Markdown, and of its note; an empty line follows each of the two."""
    rows = [[*map(escape_cell, table.head)], *(list(map(_in_markdown, row)) for row in table.rows)]
    lines = [f"| {' | '.join(row)} |" for row in rows]
    lines.insert(1, "|---|" + "---:|" * (len(table.head) - 1))
    return [*lines, "", *[table.note, ""] * bool(table.note)]


def escape_cell(name: str) -> str:
    """Escape a user's name as a cell of a table in Markdown."""
    return re.sub(r"[\\`*<$|]", r"\\\g<0>", " ".join(name.splitlines()))


def _as_text(tables: Sequence[TextTable], notes: Sequence[str]) -> str:
    drawn = StringIO()
    plain = Console(
        file=drawn, width=_FILE_WIDTH, force_terminal=False, force_jupyter=False, color_system=None
    )
    plain.print(*tables, *map(Text, notes), sep="\n")
    return drawn.getvalue()


def _as_markdown(tables: Sequence[TextTable], notes: Sequence[str]) -> str:
    lines = [line for table in tables for line in (table.heading, "", *markdown(table))]
    return "\n".join([*lines, *notes, ""])


def _as_latex(tables: Sequence[TextTable], notes: Sequence[str]) -> str:
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


def _as_csv(tables: Sequence[TextTable], notes: Sequence[str]) -> str:
    """Return a CSV with a row for each cell.

    The columns "table", "row" and "column" hold the heading of the cell's table, the names of its row and the
    head of its column. An estimate has its numbers in further columns, and another cell has its "text".
    """
    from cprl.measuring.statistics import ESTIMATE_COLUMNS, estimate_row

    written = StringIO(newline="")
    writer = csv.DictWriter(
        written, ["table", "row", "column", *ESTIMATE_COLUMNS, "text"], lineterminator="\n"
    )
    writer.writeheader()
    for table in tables:
        name_columns = max(table.texts, 1)
        for row in table.rows:
            names = ", ".join(map(str, row[:name_columns]))
            position = {"table": " ".join(table.heading.split()), "row": names}
            for head, cell in zip(table.head[name_columns:], row[name_columns:], strict=True):
                content = cell.estimate if isinstance(cell, Change) else cell
                numbers = {"text": content} if isinstance(content, str) else estimate_row(content)
                # Episodes are not counted for a difference, and a mean is not tested.
                absent = ("episodes", "undefined") if isinstance(cell, Change) else ("p_value", "differs")
                for column in absent:
                    numbers.pop(column, None)
                writer.writerow({**position, "column": head, **numbers})
    return written.getvalue()


WRITERS: Final = {".txt": _as_text, ".md": _as_markdown, ".tex": _as_latex, ".csv": _as_csv}
"""The functions that write tables as text, by the suffix of a file's name."""


def _is_bold(cell: TableCell) -> bool:
    return isinstance(cell, Change) and cell.estimate.differs


def _marked(cell: TableCell, template: str) -> str:
    """Return the text of a cell, with differences that are not 0 in a template, see `Change.marked`."""
    return cell.marked(template) if isinstance(cell, Change) else str(cell)


def _marked_by_star(cell: TableCell) -> str:
    return _marked(cell, "{} *")


def _in_markdown(cell: TableCell) -> str:
    return escape_cell(cell) if isinstance(cell, str) else _marked(cell, "**{}**")


def _in_latex(cell: TableCell) -> str:
    if isinstance(cell, str):
        return " ".join(cell.split()).translate(_LATEX_ESCAPES)
    return re.sub(r"-(?=[\d.])", "$-$", _marked(cell, r"\textbf{{{}}}"))


class _NameWrapper(TextWrapper):
    """Breaks lines also within names, after the signs that join their words: `commons_targets_10`."""

    wordsep_re = re.compile(r"(\s+|(?<=[_/,=-])(?=\w))")


def wrap_lines(text: str, most: int) -> str:
    """Break a text into lines of at most `most` characters, if necessary within names."""
    has_long_word = any(len(word) > most for word in text.split())
    fill = (_NameWrapper if has_long_word else TextWrapper)(most, break_long_words=False).fill
    return "\n".join(fill(line) for line in text.splitlines())


def _total(widths: Sequence[int]) -> int:
    """Return the width of a table with its borders."""
    return sum(widths) + 3 * len(widths) + 1


def _column_blocks(widths: Sequence[int], texts: int, room: int) -> Iterator[list[int]]:
    """Yield the columns of each of the tables into which a wide table is split; all begin with the names."""
    names = list(range(texts))
    block = list(names)
    for column in range(texts, len(widths)):
        if len(block) > texts and _total([widths[index] for index in (*block, column)]) > room:
            yield block
            block = list(names)
        block.append(column)
    yield block


def _longest(text: str) -> int:
    """Return the length of the longest line of a text."""
    return max(map(len, text.splitlines()), default=0)


def _interval_below(estimate: str) -> str:
    """Return the text of an estimate with its interval, and its count of undefined episodes, on new lines."""
    return re.sub(r",? ?(\[|undefined in)", r"\n\1", estimate).lstrip("\n")
