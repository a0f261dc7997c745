"""The progress of a study in the terminal: one table for all its trials, or plain lines in a file or pipe."""

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from threading import Event, Thread
from types import TracebackType
from typing import Any, Final, Self

from rich.console import Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from cprl.studies.overview import Overview, Snapshot, label_of
from cprl.studies.trials import Outcome, Trial
from cprl.system.output import Output, console

_TABLE_PERIOD_S: Final = 1.0
_LINE_PERIOD_S: Final = 10.0
"""Seconds between updates of the table, and between lines if the output is not a terminal."""
_OTHER_LINES: Final = 8
"""Of the terminal's height, for all that is not a row."""
_FEWEST_ROWS: Final = 3
_COLOURS: Final = {"failed": "red", "finished": "green", "missing": "dim", "unfinished": "dim"}


class Progress:
    """Shows how far all trials are, while an executor runs them; a context manager.

    It reads what the trials write (see `cprl.studies.overview`) in a thread of its own. What they print goes
    elsewhere: the output is that of the moment in which the block begins.

    Args:
        trials: all that are shown.
        runs: the directory of their runs.
        status: the directory in which they say how far they are.
        title: what the study is called.
        is_shown: whether anything is printed.
    """

    def __init__(
        self,
        trials: Sequence[Trial],
        *,
        runs: Path,
        status: Path,
        title: str,
        is_shown: bool = True,
    ) -> None:
        stream = getattr(sys.stdout, "rich_proxied_file", sys.stdout)  # trials replace sys.stdout
        self._console = console(Output(lambda: stream))
        self._labels = {trial.name: label_of(trial) for trial in trials}
        self._failures: dict[str, str] = {}
        self._overview = Overview(trials, runs=runs, status=status, failures=self._failures)
        self._title, self._is_shown = title, is_shown
        self._ended = 0
        self._is_over = Event()
        self._live: Live | None = None
        self._thread = Thread(target=self._watch, daemon=True, name="cprl study")

    def say(self, text: str) -> None:
        """Prints a line, above the table where there is one."""
        if self._is_shown:
            self._console.print(text, soft_wrap=True, markup=False, highlight=False)

    def ended(self, outcome: Outcome) -> None:
        """Notes how a trial has ended."""
        self._ended += 1
        if outcome.state == "failed":
            self._failures[outcome.name] = outcome.reason
        if outcome.worked and self._live is None:
            why = f": {outcome.reason}" if outcome.reason else ""
            label = self._labels.get(outcome.name, outcome.name)
            self.say(f"{self._title}: {label} {outcome.state}{why} ({self._ended} of {len(self._labels)})")

    def __enter__(self) -> Self:
        now = self._overview.look()
        if self._is_shown and self._console.is_terminal:
            self._live = Live(
                self._table(now),
                console=self._console,
                auto_refresh=False,
                redirect_stdout=False,
                redirect_stderr=False,
            )
            self._live.start(refresh=True)
        else:
            self.say(f"{self._title}: {now.line}")
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._is_over.set()
        self._thread.join()
        now = self._show(self._overview.look())
        if self._live is not None:
            self._live.stop()
        else:
            self.say(f"{self._title}: {now.line}")

    def _watch(self) -> None:
        said_s, period_s = time.monotonic(), _TABLE_PERIOD_S
        while not self._is_over.wait(period_s):
            began_s = time.monotonic()
            now = self._show(self._overview.look())
            if self._live is None and began_s - said_s >= _LINE_PERIOD_S:
                said_s = began_s
                self.say(f"{self._title}: {now.line}")
            period_s = max(_TABLE_PERIOD_S, 20 * (time.monotonic() - began_s))  # of thousands of trials

    def _show(self, now: Snapshot) -> Snapshot:
        if self._live is not None:
            self._live.update(self._table(now), refresh=True)
        return now

    def _table(self, now: Snapshot) -> Any:
        return table_of(now, title=self._title, most=max(_FEWEST_ROWS, self._console.height - _OTHER_LINES))


def table_of(now: Snapshot, *, title: str, most: int | None = None) -> Any:
    """The table of a study for a terminal, with at most so many rows; what the rest is stands below."""
    rows, rest = now.fitting(len(now.rows) if most is None else most)
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("trial", no_wrap=True, overflow="ellipsis")
    table.add_column("state", no_wrap=True)
    table.add_column("episodes", justify="right", no_wrap=True)
    table.add_column("", no_wrap=True, overflow="ellipsis")
    for row in rows:
        episodes = f"{row.episodes:,}/{row.of:,}"
        state = Text(row.state, style=_COLOURS.get(row.state, ""))
        table.add_row(Text(row.label), state, episodes, Text(row.note))
    end = [Text(rest, style="dim")] if rest else []
    return Group(Text(title, style="bold"), table, *end, Text(now.line))
