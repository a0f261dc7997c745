"""The progress of a study: a live table of its trials in a terminal, or lines in a file or pipe."""

import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Thread
from typing import Any, Final, Literal, NamedTuple, Self

from rich.console import Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from cprl.studies.status import Status
from cprl.studies.tables.sources import REASONS
from cprl.studies.trials import Trial, TrialOutcome
from cprl.system.output import Output, console
from cprl.system.working import silent
from cprl.terminal.progress import format_duration

_TABLE_PERIOD_S: Final = 1.0
_LINE_PERIOD_S: Final = 10.0
"""Seconds between updates of the table, and between lines if the output is not a terminal."""
_OTHER_LINES: Final = 8
"""The lines of the terminal that are kept free of rows."""
_FEWEST_ROWS: Final = 3
_COLOURS: Final = {"failed": "red", "finished": "green", "waiting": "dim", "unfinished": "dim"}
SILENT_S: Final = 10.0
"""Seconds without a sign of life after which a trial no longer counts as running."""

TrialState = Literal["running", "compiling", "evaluating", "failed", "unfinished", "waiting", "finished"]
AT_WORK: Final = ("running", "compiling", "evaluating")
_STATE_ORDER: Final[tuple[TrialState, ...]] = (*AT_WORK, "failed", "unfinished", "waiting", "finished")
"""The order in which a table lists trials: running trials first, finished ones last."""


class TrialProgress(NamedTuple):
    """The progress of one trial."""

    trial: Trial
    state: TrialState
    episodes: int
    """Episodes of all its replicas; of one that trains so many steps, the share of those expected."""
    of: int
    per_s: float = 0.0
    """Episodes per second; 0 where that is not known."""
    note: str = ""
    """The time left, or the reason of a failure."""

    @property
    def unit(self) -> str:
        """Return the unit in which the experiment states its length: "episodes" or "steps"."""
        return self.trial.experiment.length.unit

    @property
    def done(self) -> int:
        """Return how many units are done."""
        return self.whole * self.episodes // self.of

    @property
    def whole(self) -> int:
        """Return how many units the trial has."""
        return self.trial.experiment.length.number * self.trial.experiment.replicas


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """The progress of all trials at one moment, in the order in which a table lists them."""

    rows: tuple[TrialProgress, ...]
    left_s: float | None
    """The estimated seconds until the study ends; None if unknown."""

    @property
    def counts(self) -> Mapping[str, int]:
        """Return the number of trials by state; compiling and evaluating trials count as running."""
        return Counter("running" if row.state in AT_WORK else row.state for row in self.rows)

    @property
    def units(self) -> list[str]:
        """Return the units of the trials: "episodes", "steps" or both."""
        return sorted({row.unit for row in self.rows})

    @property
    def line(self) -> str:
        """Return the progress of the study as a line of text."""
        counts = self.counts
        parts = [f"{counts.get('finished', 0)} of {len(self.rows)} trials finished"]
        parts += [f"{counts[state]} {state}" for state in ("running", "failed") if counts.get(state)]
        for unit in self.units:
            rows = [row for row in self.rows if row.unit == unit]
            parts.append(f"{sum(row.done for row in rows):,} of {sum(row.whole for row in rows):,} {unit}")
        compiling = sum(row.state == "compiling" for row in self.rows)
        parts += [f"{compiling} compiling"] if compiling else []
        parts += [f"{format_duration(self.left_s)} left"] if self.left_s is not None else []
        return ", ".join(parts)


class Overview:
    """Finds out how far the trials of a study are, from their directories and status files.

    A trial is running if its status changes between two calls of `look`: clocks of different hosts are never
    compared.
    """

    def __init__(self, trials: Sequence[Trial], status: Path) -> None:
        self._trials = trials
        self._status = {trial.name: Status(status, trial.name) for trial in trials}
        self._last: dict[str, Mapping[str, Any]] = {}
        self._since: dict[str, float] = {}
        """The time of the last change of a trial's status, by the clock of this process."""
        self._finished: set[str] = set()
        self.failures: dict[str, str] = {}
        """The reasons of failed trials, by name; their directories may look finished or running."""
        self._per_s: float | None = None

    def look(self) -> Snapshot:
        """Return the progress of all trials now."""
        rows = sorted(map(self._row, self._trials), key=lambda row: _STATE_ORDER.index(row.state))
        self._per_s = sum(row.per_s for row in rows) or self._per_s
        to_do = sum(row.of - row.episodes for row in rows if row.state not in ("finished", "failed"))
        left_s = None if self._per_s is None or not to_do else to_do / self._per_s
        return Snapshot(rows=tuple(rows), left_s=left_s)

    def _row(self, trial: Trial) -> TrialProgress:
        """Return the progress of one trial, from its directory and its status."""
        of = trial.experiment.length.episodes * trial.experiment.replicas
        state = "finished" if trial.name in self._finished else trial.state()
        reason = self.failures.get(trial.name)
        if state == "finished" and reason is None:
            self._finished.add(trial.name)
            return TrialProgress(trial, "finished", of, of)
        status = self._read_status(trial.name)
        is_known = state != "missing" or trial.name in self._since
        episodes = min(of, status.get("episodes", 0)) if is_known else 0
        if reason is not None or time.monotonic() - self._since.get(trial.name, -SILENT_S) >= SILENT_S:
            note = reason or self._status[trial.name].failure()
            note = note or (REASONS["refused"] if state == "refused" else "")
            idle: TrialState = "waiting" if state == "missing" else "unfinished"
            if note:
                idle = "failed"
            return TrialProgress(trial, idle, episodes, of, note=note)
        per_s = status.get("episodes_per_s") or 0.0
        left = f"{format_duration((of - episodes) / per_s)} left" if per_s else ""
        running = TrialProgress(trial, "running", episodes, of, per_s, left)
        if status.get("is_compiling"):
            note = f"for {format_duration(status.get('compiling_s', 0.0))}"
            return running._replace(state="compiling", note=note)
        if episodes == of:
            return running._replace(state="evaluating", note="")
        return running

    def _read_status(self, name: str) -> Mapping[str, Any]:
        """Read the status of a trial, and note the time if it has changed.

        The first status that is read may be from a process that is dead: it counts as a change only if the
        process has just begun.
        """
        status = self._status[name].read()
        if status != self._last.get(name, {}):
            if name in self._last or status.get("beat", 0) <= 1:
                self._since[name] = time.monotonic()
            self._last[name] = status
        return status


class Progress:
    """Shows the progress of all trials while an executor runs them; a context manager.

    A thread of its own reads the status files. It prints to the output of the time when it is created, as
    trials that run in this process redirect theirs.

    Args:
        title: the name of the study.
        is_shown: whether anything is printed.
    """

    def __init__(self, trials: Sequence[Trial], status: Path, *, title: str, is_shown: bool = True) -> None:
        stream = sys.stdout  # which trials replace that run in this process
        self._console = console(Output(lambda: stream))
        self._labels = {trial.name: trial.label for trial in trials}
        self._overview = Overview(trials, status)
        self._title = title
        self._is_shown = is_shown
        self._ended = 0
        self._is_over = Event()
        self._live: Live | None = None
        self._thread = Thread(target=self._watch, daemon=True, name="cprl study")
        self._silence = silent()

    def say(self, text: str) -> None:
        """Print a line, unless nothing is shown."""
        if self._is_shown:
            self._console.print(text, soft_wrap=True, markup=False, highlight=False)

    def ended(self, outcome: TrialOutcome) -> None:
        """Count a trial that has ended; print a line if there is no live table."""
        self._ended += 1
        if outcome.state == "failed":
            self._overview.failures[outcome.name] = outcome.reason
        if outcome.worked and self._live is None:
            why = f": {outcome.reason}" if outcome.reason else ""
            label = self._labels.get(outcome.name, outcome.name)
            self.say(f"{self._title}: {label} {outcome.state}{why} ({self._ended} of {len(self._labels)})")

    def __enter__(self) -> Self:
        self._silence.__enter__()
        if self._is_shown and self._console.is_terminal:
            self._live = Live(
                console=self._console, auto_refresh=False, redirect_stdout=False, redirect_stderr=False
            )
            self._live.start()
        self._show(is_line=True)
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._is_over.set()
        self._thread.join()
        self._show(is_line=True)
        if self._live is not None:
            self._live.stop()
        self._silence.__exit__(None, None, None)

    def _watch(self) -> None:
        """Show the progress again and again until the end; the body of the thread."""
        said_s = time.monotonic()
        period_s = _TABLE_PERIOD_S
        while not self._is_over.wait(period_s):
            began_s = time.monotonic()
            is_line = began_s - said_s >= _LINE_PERIOD_S
            said_s = began_s if is_line else said_s
            self._show(is_line=is_line)
            period_s = max(_TABLE_PERIOD_S, 20 * (time.monotonic() - began_s))  # of thousands of trials

    def _show(self, *, is_line: bool) -> None:
        now = self._overview.look()
        if self._live is not None:
            most = max(_FEWEST_ROWS, self._console.height - _OTHER_LINES)
            self._live.update(progress_table(now, title=self._title, most=most), refresh=True)
        elif is_line:
            self.say(f"{self._title}: {now.line}")


def progress_table(now: Snapshot, *, title: str, most: int | None = None) -> Any:
    """Return the table of a study for a terminal.

    Args:
        most: the largest number of rows; a line below counts the other trials.
    """
    rows = now.rows
    rest = ""
    if most is not None and len(rows) > most:
        states = Counter(row.state for row in rows[most - 1 :])
        rest = "and " + ", ".join(f"{states[state]} {state}" for state in _STATE_ORDER if states[state])
        rows = rows[: most - 1]
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("trial", no_wrap=True, overflow="ellipsis")
    table.add_column("state", no_wrap=True)
    table.add_column(" or ".join(now.units), justify="right", no_wrap=True)
    table.add_column("", no_wrap=True, overflow="ellipsis")
    for row in rows:
        state = Text(row.state, style=_COLOURS.get(row.state, ""))
        table.add_row(Text(row.trial.label), state, f"{row.done:,}/{row.whole:,}", Text(row.note))
    end = [Text(rest, style="dim")] if rest else []
    return Group(Text(title, style="bold"), table, *end, Text(now.line))
