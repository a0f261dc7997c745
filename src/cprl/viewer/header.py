"""The header of a recording: where the run is, in large type, and below it how to read the plots."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isnan
from statistics import fmean, stdev

from cprl.measuring.episodes import Episode


@dataclass(frozen=True, kw_only=True)
class Played:
    """Episodes in fresh worlds, in numbers."""

    mean: float
    """The mean collective return in apples, or where the game reports no harvest the mean summed return."""
    error: float
    """Its standard error over episodes; NaN for a single one."""
    died: int | None
    """Episodes whose board died before the time was up; None where the game reports no stock."""
    episodes: int


def played(episodes: Sequence[Episode]) -> Played:
    """The numbers of at least one episode."""
    values = [earned(episode) for episode in episodes]
    died = [has_died(episode) for episode in episodes]
    return Played(
        mean=fmean(values),
        error=stdev(values) / len(values) ** 0.5 if len(values) > 1 else float("nan"),
        died=None if None in died else sum(map(bool, died)),
        episodes=len(values),
    )


def earned(episode: Episode) -> float:
    """Apples that all agents harvested, or the sum of their returns where the game reports no harvest."""
    return float(episode.metrics.get("collective_return", episode.return_.sum()))


def has_died(episode: Episode) -> bool | None:
    """Whether the episode ended before its time because no apple was left; None if no stock is reported."""
    return None if episode.depletion_step is None else episode.terminated


@dataclass(frozen=True, kw_only=True)
class Header:
    """The Markdown texts of one run's header."""

    episodes: int
    """Of the run."""
    replicas: int
    unit: str
    """"apples" or "return"."""

    def begins(self, status: str) -> str:
        """Before the first episode has ended."""
        return f"# Episode 1 of {self.episodes:,} · {status}"

    def line(
        self, *, episode: int, label: str, mean: float, random_play: float | None, died: float | None
    ) -> str:
        """After an episode.

        Args:
            episode: its number, from 1 on.
            label: of `cprl.measuring.now`.
            mean: the running mean that the label judges.
            random_play: the mean of random play, if it is known.
            died: boards that died early in the episode; None or NaN for a game that reports no stock.
        """
        beside = "" if random_play is None else f" (random play {_number(random_play)})"
        parts = [f"Episode {episode:,} of {self.episodes:,}", label, f"{self._amount(mean)}{beside}"]
        if died is not None and not isnan(died):
            parts.append(self._died(round(died), self.replicas))
        return "# " + " · ".join(filter(None, parts))

    def finished(self, trained: Played, random: Played) -> str:
        """After the evaluation of a run: the trained policy beside the random one, in fresh worlds."""
        died = "" if trained.died is None else f" · {self._died(trained.died, trained.episodes)}"
        return (
            f"# Finished, {self.episodes:,} episodes · trained {self._amount(trained.mean)}, "
            f"random play {_number(random.mean)}{died}"
        )

    def ended(self, mean: float) -> str:
        """At the end of a training without an evaluation."""
        return f"# Finished, {self.episodes:,} episodes · {self._amount(mean)} at the end"

    def stopped(self, episode: int, mean: float) -> str:
        """At the end of a run that was stopped after so many episodes; it can be resumed."""
        amount = "" if isnan(mean) else f" · {self._amount(mean)}"
        return f"# Stopped after {episode:,} of {self.episodes:,} episodes{amount}"

    def notes(self, *, window: int, of_mean: int | None = None) -> str:
        """How to read the lines of plots.

        Args:
            window: episodes of the bold lines' running mean.
            of_mean: episodes of the mean in the line above, if it has one.
        """
        one = "one episode's mean over replicas" if self.replicas > 1 else "one episode"
        singles = f"; thin, each of {self.replicas} replicas" if self.replicas > 1 else ""
        above = f"{self.unit.capitalize()} above: mean of the last {of_mean} episodes. " if of_mean else ""
        return (
            f"{above}Lines: bold, mean of the last {window} episodes; faint, {one}{singles}; "
            "grey, random play; agents in their colours."
        )

    def _amount(self, value: float) -> str:
        return f"{_number(value)} apples" if self.unit == "apples" else f"{self.unit} {_number(value)}"

    def _died(self, died: int, boards: int) -> str:
        if boards == 1:
            return "the board died early" if died else ""
        return f"{died:,} of {boards:,} boards died early"


def _number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
