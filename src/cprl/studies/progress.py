"""The progress of a study in the terminal: one table for all its trials, or plain lines in a file or pipe."""

import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event, Thread
from typing import Any, Final, Literal, Self

from rich.console import Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from cprl.studies.tables.sources import REASONS
from cprl.studies.trials import Outcome, Status, Trial
from cprl.system.output import Output, console
from cprl.terminal.progress import in_words

_TABLE_PERIOD_S: Final = 1.0
_LINE_PERIOD_S: Final = 10.0
"""Seconds between updates of the table, and between lines if the output is not a terminal."""
_OTHER_LINES: Final = 8
"""Of the terminal's height, for all that is not a row."""
_FEWEST_ROWS: Final = 3
_COLOURS: Final = {"failed": "red", "finished": "green", "missing": "dim", "unfinished": "dim"}


TrialState = Literal["running", "compiling", "evaluating", "failed", "unfinished", "missing", "finished"]


AT_WORK: Final = ("running", "compiling", "evaluating")


ORDER: Final[tuple[TrialState, ...]] = (*AT_WORK, "failed", "unfinished", "missing", "finished")
"""In which a table lists trials: what is under way first, what needs nobody last."""


SILENT_S: Final = 10.0
"""Seconds without a sign of life after which a trial no longer counts as running."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """How far one trial is."""

    trial: Trial
    state: TrialState
    episodes: int
    """Of all its replicas."""
    of: int
    left_s: float | None = None
    """Of a running one, once it is known."""
    compiling_s: float = 0.0
    reason: str = ""
    """Of a failure, in a line."""

    @property
    def label(self) -> str:
        """Its condition, and which replicas of it."""
        return label_of(self.trial)

    @property
    def note(self) -> str:
        """What else there is to say of it, in some words."""
        if self.state == "compiling":
            return f"for {in_words(self.compiling_s)}"
        if self.state == "running" and self.left_s is not None:
            return f"{in_words(self.left_s)} left"
        return self.reason


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """All trials at a moment, in the order in which a table lists them."""

    rows: tuple[Row, ...]
    left_s: float | None
    """Of the whole study, once it is known."""

    @property
    def counts(self) -> Mapping[str, int]:
        """Trials by state."""
        return Counter("running" if row.state in AT_WORK else row.state for row in self.rows)

    @property
    def line(self) -> str:
        """The study in a line."""
        counts = self.counts
        parts = [f"{counts.get('finished', 0)} of {len(self.rows)} trials finished"]
        parts += [f"{counts[own]} {own}" for own in ("running", "failed") if counts.get(own)]
        played, of = (sum(getattr(row, own) for row in self.rows) for own in ("episodes", "of"))
        parts.append(f"{played:,} of {of:,} episodes")
        compiling = sum(row.state == "compiling" for row in self.rows)
        parts += [f"{compiling} compiling"] if compiling else []
        parts += [f"{in_words(self.left_s)} left"] if self.left_s is not None else []
        return ", ".join(parts)

    def fitting(self, most: int) -> tuple[tuple[Row, ...], str]:
        """The first rows, at most so many, and what the rest of them is, in words."""
        if len(self.rows) <= most:
            return self.rows, ""
        rest = Counter(row.state for row in self.rows[most - 1 :])
        return self.rows[: most - 1], "and " + ", ".join(
            f"{rest[state]} {state}" for state in ORDER if rest[state]
        )


@dataclass(eq=False)
class _Seen:
    """What a trial has said so far."""

    said: dict[str, Any] = field(default_factory=dict)
    since: float = 0.0
    """When it said this, by the clock of this process; 0 for what it may have said long ago."""
    base: tuple[int, float] | None = None
    """Episodes and seconds of work when its speed was first measured."""
    speed: float | None = None
    """Episodes per second."""


class Overview:
    """Looks at every trial of a study, as often as it is asked.

    Nobody's clock is compared with anybody else's: a trial runs if what it says changes between two looks.

    Args:
        failures: the reasons of those that failed, by trial; may grow between two looks. None: those that
            are noted in `status`.
    """

    def __init__(
        self, trials: Sequence[Trial], *, runs: Path, status: Path, failures: Mapping[str, str] | None = None
    ) -> None:
        self._trials, self._runs, self._failures = trials, runs, failures
        self._status = {trial.name: Status(status, trial.name) for trial in trials}
        self._seen = {trial.name: _Seen() for trial in trials}
        self._finished: set[str] = set()
        self._rate: float | None = None

    def look(self) -> Snapshot:
        """All trials as they are now."""
        rows = [self._row(trial) for trial in self._trials]
        speeds = [self._seen[row.trial.name].speed or 0.0 for row in rows if row.state in AT_WORK]
        self._rate = sum(speeds) or self._rate
        to_do = sum(row.of - row.episodes for row in rows if row.state not in ("finished", "failed"))
        left_s = None if self._rate is None or not to_do else to_do / self._rate
        rows.sort(key=lambda row: ORDER.index(row.state))
        return Snapshot(rows=tuple(rows), left_s=left_s)

    def _row(self, trial: Trial) -> Row:
        of = trial.experiment.episodes * trial.experiment.replicas
        state = "finished" if trial.name in self._finished else trial.state(self._runs)
        if state == "finished":
            self._finished.add(trial.name)
            return Row(trial=trial, state="finished", episodes=of, of=of)
        seen = self._listen(trial)
        episodes = 0 if state == "missing" and not seen.since else min(of, _number(seen.said, "episodes"))
        if seen.since and time.monotonic() - seen.since < SILENT_S:
            at_work: TrialState = "evaluating" if episodes == of else "running"
            return Row(
                trial=trial,
                state="compiling" if seen.said.get("is_compiling") is True else at_work,
                episodes=episodes,
                of=of,
                left_s=(of - episodes) / seen.speed if seen.speed else None,
                compiling_s=_number(seen.said, "compiling_s"),
            )
        reason = self._failure(trial) or (REASONS["refused"] if state == "refused" else None)
        if reason is not None:
            return Row(trial=trial, state="failed", episodes=episodes, of=of, reason=reason)
        unfinished: TrialState = "missing" if state == "missing" else "unfinished"
        return Row(trial=trial, state=unfinished, episodes=episodes, of=of)

    def _listen(self, trial: Trial) -> _Seen:
        """What a trial says now, and how fast it is."""
        seen, said = self._seen[trial.name], self._status[trial.name].read()
        if said == seen.said:
            return seen
        is_same = said.get("pid") == seen.said.get("pid") and said.get("host") == seen.said.get("host")
        if not is_same:
            seen.base = seen.speed = None
        if seen.said or _is_new(said):  # the first time it may be what a dead process said
            seen.since = time.monotonic()
        seen.said = said
        now = _number(said, "episodes"), _number(said, "running_s") - _number(said, "compiling_s")
        if seen.base is None and _number(said, "steps"):  # before, a resumed one has not yet said where it is
            seen.base = now
        elif seen.base is not None and now[0] > seen.base[0] and now[1] > seen.base[1]:
            seen.speed = (now[0] - seen.base[0]) / (now[1] - seen.base[1])
        return seen

    def _failure(self, trial: Trial) -> str | None:
        if self._failures is not None:
            return self._failures.get(trial.name)
        return self._status[trial.name].failure()


def label_of(trial: Trial) -> str:
    """The condition of a trial, and which replicas of it."""
    first, last = trial.block.first, trial.block.first + trial.block.replicas - 1
    numbers = f"replica {first}" if first == last else f"replicas {first}-{last}"
    return f"{trial.condition.name}, {numbers}"


def _is_new(said: Mapping[str, Any]) -> bool:
    """Whether a status was written by a process that has just begun."""
    return bool(_number(said, "beat") <= 1)


def _number(said: Mapping[str, Any], name: str) -> Any:
    value = said.get(name, 0)
    return value if isinstance(value, int | float) else 0


class Progress:
    """Shows how far all trials are, while an executor runs them; a context manager.

    It reads what the trials write (see `cprl.studies.progress`) in a thread of its own. What they print goes
    elsewhere: the output is that of the moment in which the block begins.

    Args:
        is_shown: whether anything is printed.
    """

    def __init__(
        self, trials: Sequence[Trial], *, runs: Path, status: Path, title: str, is_shown: bool = True
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

    def __exit__(self, kind: object, error: object, traceback: object) -> None:
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
