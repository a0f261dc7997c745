"""The progress of a training in the terminal."""

from collections import deque
from collections.abc import Mapping
from threading import Event, Thread
from types import TracebackType
from typing import Any, Final, Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn
from rich.table import Column
from rich.text import Text
from tensordict import TensorDictBase

from cprl.measuring.episodes import Episode
from cprl.system.output import NotebookLine
from cprl.system.output import console as safe_console
from cprl.system.times import CLOCK, Speed
from cprl.system.working import silent

_BAR_PERIOD_S: Final = 0.25
_NOTEBOOK_PERIOD_S: Final = 1.0
_LINE_PERIOD_S: Final = 10.0
"""Seconds between updates of the bar, in a terminal and in a notebook, and between lines elsewhere."""
_NOTEBOOK_CELLS: Final = 20
"""The width of a notebook's bar, in characters."""
COMPILING_PERIOD_S: Final = 2.0
"""Seconds of compiling after which a line says so, and between such lines."""
TIMED_STEPS: Final = 20
"""Steps that are timed before a remaining time is shown."""


def in_words(seconds: float) -> str:
    """A duration: "47 s", "12 min", "3 h 05 min"."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60:,} h {minutes % 60:02} min"


class ProgressBar:
    """A bar with the return, epsilon, steps per second and the time left.

    The return is the mean of the last episodes, as many as all replicas have worlds. While code is compiled
    the bar says so, and for how long; that time does not count for the rest. In a notebook it is one line of
    text, which is written over; elsewhere, without a terminal, a plain line is printed every ten seconds. A
    callback of `cprl.training`, and a context manager.

    Args:
        game: a game or its environment. The length of an episode is `episode_steps` of its `rules`, if it has
            them; else that of the last episode.
        episodes: of each replica, about.
        steps: of each replica; None for a training of so many episodes. The bar counts what is given.
        worlds: of each replica.
    """

    def __init__(
        self,
        game: object = None,
        *,
        episodes: int,
        steps: int | None = None,
        title: str = "training",
        replicas: int = 1,
        worlds: int = 1,
        console: Console | None = None,
    ) -> None:
        self.console = console or safe_console()
        rules = getattr(getattr(game, "game", game), "rules", None)
        self._title, self._clock = title, getattr(rules, "episode_steps", None)
        self._last_steps = 0
        self._progress = Progress(
            TextColumn("{task.description}", markup=False, table_column=Column(no_wrap=True, ratio=1)),
            BarColumn(None, table_column=Column(ratio=1)),
            MofNCompleteColumn(table_column=Column(no_wrap=True)),
            _Now(table_column=Column(no_wrap=True)),
            console=self.console,
            expand=True,
            disable=not self.console.is_terminal,
        )
        elsewhere_s = _NOTEBOOK_PERIOD_S if self.console.is_jupyter else _LINE_PERIOD_S
        self._period_s = _BAR_PERIOD_S if self.console.is_terminal else elsewhere_s
        self._all_steps = steps
        self._task = self._progress.add_task(title, total=steps or episodes, values="")
        self._latest = {"return": "-", "epsilon": ""}
        self._turns = self._steps = self._steps_running = self._episodes = 0
        self._speed = Speed()
        self._course = Speed()
        """How fast steps, and episodes or steps of each replica, are done."""
        self._left_of, self._replicas = steps or episodes, replicas
        self._worlds = replicas * worlds
        self._returns: deque[float] = deque(maxlen=self._worlds)
        self._notebook_line = NotebookLine()
        self._silence = silent()
        self._compiled_before_s = CLOCK.total_s
        self._is_over, self._lines = Event(), Thread(target=self._say_compiling, daemon=True)

    @classmethod
    def of(cls, experiment: Any) -> Self:
        """Return the bar of an `Experiment`."""
        return cls(
            experiment.game,
            episodes=experiment.length.episodes,
            steps=experiment.steps,
            replicas=experiment.replicas,
            worlds=experiment.worlds,
        )

    def on_start(self, training: Any) -> None:
        """Continues where the training does."""
        self._steps = training.steps * self._replicas
        self._episodes = training.episodes_played

    def on_step(self, batch: TensorDictBase) -> None:
        """Counts the turns of a batch and updates the bar if it is due."""
        if not self._turns:  # do not count the time before the first step
            self._speed, self._course = Speed(self._steps), Speed(self._done())
        self._turns += 1
        self._steps += batch.numel()
        self._steps_running += batch.numel()
        if self._speed.waited_s > self._period_s:
            self._show()

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        self._episodes += 1
        self._steps_running = max(0, self._steps_running - episode.steps)
        self._last_steps = episode.steps
        self._returns.append(float(episode.return_.sum()))
        mean = sum(self._returns) / len(self._returns)
        self._latest["return"] = f"{mean:{'.0f' if episode.harvest is not None else '.4g'}}"
        epsilons = [value for name, value in learning.items() if name.endswith("/epsilon")]
        if any(epsilons):
            self._latest["epsilon"] = f"{max(epsilons):.2f}"

    def _show(self) -> None:
        values = f"return {self._latest['return']}"
        if self._latest["epsilon"]:
            values += f"  epsilon {self._latest['epsilon']}"
        values += f"  {self._speed.lap(self._steps):,.0f} steps/s"
        done = self._done()
        values += self._time_left(done)
        self._progress.update(self._task, completed=done, values=values)
        if not self.console.is_terminal:
            at = f"episode {self._episodes // self._replicas}/{self._left_of}"
            if self._all_steps is not None:
                at = f"step {done:,.0f}/{self._left_of:,}"
            self._print(f"{self._title}: {at}  {values}", done)

    def _print(self, words: str, done: float) -> None:
        """Print a line; in a notebook over the one before, behind a bar."""
        if not self.console.is_jupyter:
            self.console.print(words, soft_wrap=True)
            return
        full = int(_NOTEBOOK_CELLS * done / max(1, self._left_of))
        self._notebook_line.show(f"{'█' * full}{'░' * (_NOTEBOOK_CELLS - full)} {words}")

    def _done(self) -> float:
        """Episodes of each replica so far, or steps; at most as many as there are to be."""
        if self._all_steps is not None:
            return min(self._left_of, self._steps / self._replicas)
        episode_steps = self._clock or self._last_steps
        running = min(self._worlds, self._steps_running / episode_steps) if episode_steps else 0
        return min(self._left_of, (self._episodes + running) / self._replicas)

    def _time_left(self, done: float) -> str:
        """The time left after so many episodes, in words; empty before enough steps were timed."""
        per_s = self._course.mean(done)
        if self._turns < TIMED_STEPS or per_s is None:
            return ""
        return f"  {in_words((self._left_of - done) / per_s)} left"

    def _say_compiling(self) -> None:
        """Prints lines while code is compiled; in a terminal the bar shows it."""
        said_s = 0.0
        while not self._is_over.wait(0.2):
            spent_s = CLOCK.total_s - self._compiled_before_s
            if CLOCK.is_running and spent_s - said_s >= COMPILING_PERIOD_S:
                said_s = spent_s
                self._print(f"{self._title}: compiling, {spent_s:.0f} s so far", self._done())

    def __enter__(self) -> Self:
        self._compiled_before_s = CLOCK.total_s
        self._silence.__enter__()
        self._progress.start()
        if not self.console.is_terminal:
            self._lines.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._is_over.set()
        if self._lines.is_alive():
            self._lines.join()
        self._steps_running = 0
        self._progress.update(self._task, completed=self._done())
        self._progress.stop()
        if self.console.is_jupyter:
            self._print(f"{self._title}: {self._episodes // self._replicas} episodes", self._done())
        self._silence.__exit__(None, None, None)


class _Now(ProgressColumn):
    """What a task says of itself, or that code is being compiled."""

    def render(self, task: Task) -> Text:
        """Called some ten times a second by rich's own thread."""
        if CLOCK.is_running:
            return Text(f"compiling, {CLOCK.total_s:.0f} s so far")
        return Text(str(task.fields["values"]))
