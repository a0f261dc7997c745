"""ProgressBar: shows in the terminal, or in a notebook, how far a training is."""

from collections import deque
from collections.abc import Callable, Mapping
from threading import Event, Thread
from typing import Any, Final, Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.table import Column
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from cprl.envs.unwrap import clock_in
from cprl.measuring.tracker import Episode
from cprl.runs.schedule import Schedule
from cprl.system.output import NotebookLine, console as safe_console
from cprl.system.times import CLOCK, Speed
from cprl.system.working import silent

_BAR_PERIOD_S: Final = 0.25
"""Seconds between updates of the bar in a terminal."""
_NOTEBOOK_PERIOD_S: Final = 1.0
"""Seconds between updates of the bar in a notebook."""
_LINE_PERIOD_S: Final = 10.0
"""Seconds between printed lines if the output is neither a terminal nor a notebook."""
_NOTEBOOK_CELLS: Final = 20
"""The width of a notebook's bar, in characters."""
COMPILING_PERIOD_S: Final = 2.0
"""Seconds of compiling before the first message about it, and between two messages."""
TIMED_STEPS: Final = 20
"""The number of steps that are timed before the time left is shown."""


def format_duration(seconds: float) -> str:
    """Return a duration as "47 s", "12 min" or "3 h 05 min"."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60:,} h {minutes % 60:02} min"


class ProgressBar:
    """A bar with the return, epsilon, steps per second and the time left.

    It is a callback of `cprl.training` and a context manager. The return is the mean of the last episodes,
    one for each world. While code is compiled, the bar says for how long; the time left does not include
    that. In a notebook the bar is one line of text, which is overwritten. If the output is neither a terminal
    nor a notebook, a plain line is printed every ten seconds.

    Args:
        schedule: the training's schedule. The bar counts episodes or steps, whichever its length is given in.
        game: a game or its environment, whose `rules` give the length of an episode, `episode_steps`. A game
            without them is taken to have episodes as long as its last one.
        title: the words before the bar.
        replicas: the number of replicas.
        console: where to print; by default the terminal.
        more: returns more words for the end of the line, "" for none.
    """

    def __init__(
        self,
        schedule: Schedule,
        game: object = None,
        *,
        title: str = "training",
        replicas: int = 1,
        console: Console | None = None,
        more: Callable[[], str] | None = None,
    ) -> None:
        self.console = console or safe_console()
        self._more = more or str
        self._title = title
        self._length = schedule.length
        self._rules_episode_steps = clock_in(getattr(game, "game", game))
        self._episode_steps = self._rules_episode_steps
        """The length of an episode, by which running episodes count in parts."""
        self._progress = Progress(
            TextColumn("{task.description}", markup=False, table_column=Column(no_wrap=True, ratio=1)),
            BarColumn(None, table_column=Column(ratio=1)),
            MofNCompleteColumn(table_column=Column(no_wrap=True)),
            TextColumn("{task.fields[words]}", markup=False, table_column=Column(no_wrap=True)),
            console=self.console,
            expand=True,
            disable=not self.console.is_terminal,
        )
        self._period_s = _LINE_PERIOD_S
        if self.console.is_terminal:
            self._period_s = _BAR_PERIOD_S
        elif self.console.is_jupyter:
            self._period_s = _NOTEBOOK_PERIOD_S
        self._task = self._progress.add_task(title, total=self._length.number, words="")
        self._return = "-"
        self._epsilon = ""
        self._turns = self._steps = self._episodes = 0
        self._unfinished_steps = 0
        """The steps of episodes that are not over."""
        self._speed = Speed()
        """Measures the steps per second of all replicas."""
        self._completion_speed = Speed()
        """Measures the episodes or steps per second of a replica, for the time left."""
        self._replicas = replicas
        self._worlds = replicas * schedule.worlds
        self._returns: deque[float] = deque(maxlen=self._worlds)
        self._notebook_line = NotebookLine()
        self._silence = silent()
        self._is_over = Event()
        self._compiling_thread = Thread(target=self._print_compiling, daemon=True)

    @classmethod
    def of(cls, experiment: Any, more: Callable[[], str] | None = None) -> Self:
        """Return the bar of an `Experiment`."""
        return cls(experiment.schedule, experiment.game, replicas=experiment.replicas, more=more)

    def on_start(self, training: Any) -> None:
        """Begin at the steps and episodes that a resumed training has already played."""
        self._steps = training.steps * self._replicas
        self._episodes = training.episodes_played

    def on_step(self, batch: TensorDictBase) -> None:
        """Count the turns of a batch and update the bar if it is due."""
        if not self._turns:  # do not count the time before the first step
            self._speed = Speed(self._steps)
            self._completion_speed = Speed(self._done())
        self._turns += 1
        self._steps += batch.numel()
        self._unfinished_steps += batch.numel()
        if self._speed.waited_s > self._period_s:
            self._show()

    def on_game(self, env: EnvBase, changes: str) -> None:
        self._unfinished_steps = 0
        self.console.print(f"From step {self._steps // self._replicas:,} on: {changes}", soft_wrap=True)

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        self._episodes += 1
        self._unfinished_steps = max(0, self._unfinished_steps - episode.steps)
        self._episode_steps = self._rules_episode_steps or episode.steps
        self._returns.append(float(episode.return_.sum()))
        mean = sum(self._returns) / len(self._returns)
        self._return = f"{mean:{'.0f' if episode.harvest is not None else '.4g'}}"
        epsilon = max((value for name, value in learning.items() if name.endswith("/epsilon")), default=0)
        if epsilon:
            self._epsilon = f"  epsilon {epsilon:.2f}"

    def _show(self) -> None:
        done = self._done()
        numbers = f"return {self._return}{self._epsilon}  {self._speed.lap(self._steps):,.0f} steps/s"
        position = f"episode {self._episodes // self._replicas}/{self._length.number}  "
        if self._length.is_of_steps:
            position = f"step {done:,.0f}/{self._length.number:,}  "
        more = self._more()
        self._print(f"{numbers}{self._time_left(done)}{f'  {more}' if more else ''}", position)

    def _print(self, text: str, position: str = "") -> None:
        """Print a text beside the bar, or in a line of a notebook or file.

        Args:
            position: the episode or step of the training, for lines; the bar shows it anyway.
        """
        done = self._done()
        self._progress.update(self._task, completed=done, words=text)
        line = f"{self._title}: {position}{text}"
        if self.console.is_jupyter:
            filled = int(_NOTEBOOK_CELLS * done / max(1, self._length.number))
            self._notebook_line.show(f"{'█' * filled}{'░' * (_NOTEBOOK_CELLS - filled)} {line}")
        elif not self.console.is_terminal:
            self.console.print(line, soft_wrap=True)

    def _done(self) -> float:
        """Return the episodes, or steps, that each replica has completed, running episodes in parts."""
        running_episodes = 0.0
        if self._episode_steps:
            running_episodes = min(self._worlds, self._unfinished_steps / self._episode_steps)
        episodes = (self._episodes + running_episodes) / self._replicas
        return self._length.reached(episodes=episodes, steps=self._steps / self._replicas)

    def _time_left(self, done: float) -> str:
        """Return the time left in words; "" before `TIMED_STEPS` steps."""
        per_s = self._completion_speed.mean(done)
        if self._turns < TIMED_STEPS or per_s is None:
            return ""
        return f"  {format_duration((self._length.number - done) / per_s)} left"

    def _print_compiling(self) -> None:
        """Print for how long code has been compiled, while it is being compiled."""
        printed_s = 0.0
        while not self._is_over.wait(0.2):
            compiled_s = CLOCK.total_s - self._earlier_compiled_s
            if CLOCK.is_running and compiled_s - printed_s >= COMPILING_PERIOD_S:
                printed_s = compiled_s
                self._print(f"compiling, {compiled_s:.0f} s so far")

    def __enter__(self) -> Self:
        self._earlier_compiled_s = CLOCK.total_s
        self._silence.__enter__()
        self._progress.start()
        self._compiling_thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._is_over.set()
        self._compiling_thread.join()
        self._unfinished_steps = 0
        self._progress.update(self._task, completed=self._done())
        self._progress.stop()
        if self.console.is_jupyter:
            self._print(f"{self._episodes // self._replicas} episodes")
        self._silence.__exit__(None, None, None)
