"""What a person sees in the terminal while a training goes on."""

import time
from collections.abc import Mapping
from types import TracebackType
from typing import Final, Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from tensordict import TensorDictBase

from cprl.commons.game import Game
from cprl.measuring.episodes import Episode

_BAR_PERIOD_S: Final = 0.25
_LINE_PERIOD_S: Final = 10.0
"""How often a bar moves, and a line is printed where the output is no terminal."""


class ProgressBar:
    """A bar with the return of the last episode, epsilon, steps per second and the time left.

    Where the output is no terminal, a plain line every ten seconds. An observer of `cprl.training`, and a
    context manager.

    Args:
        game: what is played; its clock says how long an episode is.
        episodes: how many there will be.
        title: what is going on.
        replicas: how many replicas play them side by side.
        console: where to; by default standard output.
    """

    def __init__(
        self,
        game: Game,
        *,
        episodes: int,
        title: str = "training",
        replicas: int = 1,
        console: Console | None = None,
    ) -> None:
        self.console = console or Console()
        self._title, self._episode_steps = title, game.rules.episode_steps
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[told]}"),
            TimeRemainingColumn(),
            console=self.console,
            disable=not self.console.is_terminal,
        )
        self._task = self._progress.add_task(title, total=episodes, told="")
        self._told = {"return": "-", "epsilon": "-"}
        self._steps = self._steps_then = self._steps_this_episode = self._episodes = 0
        self._started = self._then = time.perf_counter()
        self._left_of, self._replicas, self._before = episodes, replicas, 0

    def on_step(self, batch: TensorDictBase) -> None:
        """Counts the turns of a batch and, now and then, moves the bar."""
        if not self._steps:  # what came before was starting up
            self._started = self._then = time.perf_counter()
        self._steps += batch.numel()
        self._steps_this_episode += batch.numel()
        waited = time.perf_counter() - self._then
        if waited > (_BAR_PERIOD_S if self.console.is_terminal else _LINE_PERIOD_S):
            self._show(waited)

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        """Takes over the return and epsilon of an episode that ended."""
        self._episodes += 1
        self._steps_this_episode = 0
        self._told["return"] = f"{episode.return_.sum():.0f}"
        epsilons = [value for name, value in learning.items() if name.endswith("/epsilon")]
        if epsilons:
            self._told["epsilon"] = f"{max(epsilons):.2f}"

    def _show(self, waited: float) -> None:
        rate = (self._steps - self._steps_then) / waited
        self._steps_then, self._then = self._steps, time.perf_counter()
        told = f"return {self._told['return']}  epsilon {self._told['epsilon']}  {rate:,.0f} steps/s"
        running = min(self._replicas, self._steps_this_episode / self._episode_steps)
        done = (self._episodes + running) / self._replicas
        self._progress.update(self._task, completed=done, told=told)
        if not self.console.is_terminal and self._steps:
            spent_s = time.perf_counter() - self._started
            since = done - self._before / self._replicas
            left_s = spent_s / since * (self._left_of - done) if since else float("nan")
            episode = self._episodes // self._replicas
            self.console.print(
                f"{self._title}: episode {episode}/{self._left_of}  {told}  {left_s:,.0f} s left",
                soft_wrap=True,
            )

    def state_dict(self) -> dict[str, int]:
        """How many episodes have ended."""
        return {"episodes": self._episodes}

    def load_state_dict(self, state: Mapping[str, int]) -> None:
        """Counts on from there."""
        self._episodes = self._before = int(state["episodes"])

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._progress.update(self._task, completed=self._episodes / self._replicas)
        self._progress.stop()
