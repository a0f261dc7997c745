"""The progress of a training in the terminal."""

from collections import deque
from collections.abc import Mapping
from threading import Event, Thread
from types import TracebackType
from typing import Any, Final, Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.table import Column
from tensordict import TensorDictBase

from cprl.measuring.episodes import Episode
from cprl.runs.schedule import Schedule
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
    """Return a duration as "47 s", "12 min" or "3 h 05 min"."""
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
        schedule: of the training. The bar counts what it is long, episodes or steps.
        game: a game or its environment. The length of an episode is `episode_steps` of its `rules`, if it has
            them; else that of the last episode.
    """

    def __init__(
        self,
        schedule: Schedule,
        game: object = None,
        *,
        title: str = "training",
        replicas: int = 1,
        console: Console | None = None,
    ) -> None:
        self.console = console or safe_console()
        rules = getattr(getattr(game, "game", game), "rules", None)
        self._title = title
        self._length = schedule.length
        self._episode_steps = self._clock = getattr(rules, "episode_steps", None)
        self._progress = Progress(
            TextColumn("{task.description}", markup=False, table_column=Column(no_wrap=True, ratio=1)),
            BarColumn(None, table_column=Column(ratio=1)),
            MofNCompleteColumn(table_column=Column(no_wrap=True)),
            TextColumn("{task.fields[words]}", markup=False, table_column=Column(no_wrap=True)),
            console=self.console,
            expand=True,
            disable=not self.console.is_terminal,
        )
        elsewhere_s = _NOTEBOOK_PERIOD_S if self.console.is_jupyter else _LINE_PERIOD_S
        self._period_s = _BAR_PERIOD_S if self.console.is_terminal else elsewhere_s
        self._task = self._progress.add_task(title, total=self._length.number, words="")
        self._return = "-"
        self._epsilon = ""
        self._turns = self._steps = self._steps_running = self._episodes = 0
        self._speed = Speed()
        self._course = Speed()
        """How fast steps, and episodes or steps of each replica, are done."""
        self._replicas = replicas
        self._worlds = replicas * schedule.worlds
        self._returns: deque[float] = deque(maxlen=self._worlds)
        self._notebook_line = NotebookLine()
        self._silence = silent()
        self._is_over = Event()
        self._lines = Thread(target=self._say_compiling, daemon=True)

    @classmethod
    def of(cls, experiment: Any) -> Self:
        """Return the bar of an `Experiment`."""
        return cls(experiment.schedule, experiment.game, replicas=experiment.replicas)

    def on_start(self, training: Any) -> None:
        """Continue where the training does."""
        self._steps = training.steps * self._replicas
        self._episodes = training.episodes_played

    def on_step(self, batch: TensorDictBase) -> None:
        """Count the turns of a batch and update the bar if it is due."""
        if not self._turns:  # do not count the time before the first step
            self._speed = Speed(self._steps)
            self._course = Speed(self._done())
        self._turns += 1
        self._steps += batch.numel()
        self._steps_running += batch.numel()
        if self._speed.waited_s > self._period_s:
            self._show()

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        self._episodes += 1
        self._steps_running = max(0, self._steps_running - episode.steps)
        self._episode_steps = self._clock or episode.steps
        self._returns.append(float(episode.return_.sum()))
        mean = sum(self._returns) / len(self._returns)
        self._return = f"{mean:{'.0f' if episode.harvest is not None else '.4g'}}"
        epsilon = max((value for name, value in learning.items() if name.endswith("/epsilon")), default=0)
        if epsilon:
            self._epsilon = f"  epsilon {epsilon:.2f}"

    def _show(self) -> None:
        done = self._done()
        words = f"return {self._return}{self._epsilon}  {self._speed.lap(self._steps):,.0f} steps/s"
        at = f"episode {self._episodes // self._replicas}/{self._length.number}  "
        if self._length.is_of_steps:
            at = f"step {done:,.0f}/{self._length.number:,}  "
        self._say(words + self._time_left(done), at)

    def _say(self, words: str, at: str = "") -> None:
        """Say how far the training is: behind the bar; where there is none in a line, which in a notebook is
        written over."""
        done = self._done()
        self._progress.update(self._task, completed=done, words=words)
        words = f"{self._title}: {at}{words}"
        if not self.console.is_jupyter:
            if not self.console.is_terminal:
                self.console.print(words, soft_wrap=True)
            return
        full = int(_NOTEBOOK_CELLS * done / max(1, self._length.number))
        self._notebook_line.show(f"{'█' * full}{'░' * (_NOTEBOOK_CELLS - full)} {words}")

    def _done(self) -> float:
        """Return the episodes of each replica so far, or steps; at most as many as there are to be."""
        running = 0.0
        if self._episode_steps:
            running = min(self._worlds, self._steps_running / self._episode_steps)
        episodes = (self._episodes + running) / self._replicas
        return self._length.reached(episodes=episodes, steps=self._steps / self._replicas)

    def _time_left(self, done: float) -> str:
        """Return the time left, in words; nothing before enough steps were timed."""
        per_s = self._course.mean(done)
        if self._turns < TIMED_STEPS or per_s is None:
            return ""
        return f"  {in_words((self._length.number - done) / per_s)} left"

    def _say_compiling(self) -> None:
        """Say how long code has been compiled, while it is."""
        said_s = 0.0
        while not self._is_over.wait(0.2):
            spent_s = CLOCK.total_s - self._compiled_before_s
            if CLOCK.is_running and spent_s - said_s >= COMPILING_PERIOD_S:
                said_s = spent_s
                self._say(f"compiling, {spent_s:.0f} s so far")

    def __enter__(self) -> Self:
        self._compiled_before_s = CLOCK.total_s
        self._silence.__enter__()
        self._progress.start()
        self._lines.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._is_over.set()
        self._lines.join()
        self._steps_running = 0
        self._progress.update(self._task, completed=self._done())
        self._progress.stop()
        if self.console.is_jupyter:
            self._say(f"{self._episodes // self._replicas} episodes")
        self._silence.__exit__(None, None, None)
