"""Story: the header, the live label, events, and at the end the phases of a training."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite, isnan
from statistics import fmean, stdev
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cprl import presets
from cprl.commons.game import Game
from cprl.measuring import phases
from cprl.measuring.episodes import Episode
from cprl.measuring.now import BEGINS, EXPLORING, Now
from cprl.measuring.phases import METRICS, PHASES, PHASES_BEGIN
from cprl.measuring.series import Values, mean_of
from cprl.runs.curves import running_mean
from cprl.viewer.logger import RerunLogger
from cprl.viewer.scenery import ANOTHER, STRIPS, Curves


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
        return f"# Episode 1 of {self.episodes:,} · {status}"

    def line(
        self, *, episode: int, label: str, mean: float, random_play: float | None, died: float | None
    ) -> str:
        """After an episode.

        Args:
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
        return f"# Finished, {self.episodes:,} episodes · {self._amount(mean)} at the end"

    def stopped(self, episode: int, mean: float) -> str:
        """At the end of a run that was stopped after so many episodes; it can be resumed."""
        amount = "" if isnan(mean) else f" · {self._amount(mean)}"
        return f"# Stopped after {episode:,} of {self.episodes:,} episodes{amount}"

    def notes(self, *, window: int, of_mean: int | None = None) -> str:
        """How to read the lines of plots.

        Args:
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


BEST_OVER: Final = 50
"""Episodes of the mean return that is compared with the best."""
BETTER: Final = 1.05
"""The factor by which a new best must exceed the last reported one."""


class EventDetector:
    """Detects events from the metrics of each episode, as means over replicas."""

    def __init__(self) -> None:
        self._means: list[list[float]] = []
        self._best = 0.0

    @property
    def returns(self) -> list[float]:
        return [mean[0] for mean in self._means]

    def add(self, means: Mapping[str, float]) -> list[str]:
        """Adds the means of an episode; returns new events as text."""
        self._means.append([means[name] for name in phases.METRICS])
        if len(self._means) % BEST_OVER:
            return []
        reached = float(np.mean(self.returns[-BEST_OVER:]))
        if not reached > BETTER * self._best:
            return []
        self._best = reached
        return [f"new best: {reached:.1f} apples per episode, mean of the last {BEST_OVER}"]

    def phases(self) -> list[phases.Phase]:
        """The phases so far, four at most; empty until there are enough episodes for one."""
        if len(self._means) < phases.SHORTEST:
            return []
        smoothed = self._smoothed()
        number = max(0, min(3, smoothed.shape[1] // phases.SHORTEST - 1))
        episodes = np.arange(smoothed.shape[1])
        metrics = dict(zip(phases.METRICS, smoothed, strict=True))
        return phases.find_phases(episodes, metrics, number=number)

    def _smoothed(self) -> NDArray[np.float64]:
        """Running means [M, E]; an undefined metric repeats its last value."""
        smoothed = running_mean(np.array(self._means).reshape(-1, len(phases.METRICS)).T)
        for row in smoothed:
            defined = np.flatnonzero(~np.isnan(row))
            row[:] = np.interp(np.arange(len(row)), defined, row[defined]) if len(defined) else 0.0
        return smoothed

    def state_dict(self) -> dict[str, Any]:
        return {"means": [list(mean) for mean in self._means], "best": self._best}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self._means = [list(mean) for mean in state["means"]]
        self._best = float(state["best"])


MOST_HEADERS: Final = 5000
"""Rows of the header in a recording, about; in longer runs some episodes have none of their own."""

_NOW, _FOUND, _PUBLISHED = STRIPS


class Story:
    """Logs what people read first: where the run is, what the group does, and what came of it.

    Args:
        window: episodes of the plots' running means, which the header names.
        game: the game, if it is one of cprl's; the published one has the study's phases beside those found.
    """

    def __init__(
        self, logger: RerunLogger, curves: Curves, *, episodes: int, window: int, game: Game | None = None
    ) -> None:
        self._logger, self._curves, self._episodes, self._window = logger, curves, episodes, window
        self._game = game
        unit = "apples" if "collective_return" in curves.metrics else "return"
        self._header = Header(episodes=episodes, replicas=curves.replicas, unit=unit)
        self._now = Now(agents=max(1, len(curves.agents)))
        self._detector = EventDetector() if set(METRICS) <= set(curves.metrics) else None
        self._random: Played | None = None
        self._ended = 0
        self._is_told = False
        # A file of a resumed run must not say so: it is shown with those before it.
        logger.log_states(_NOW, {0: BEGINS}, live_only=True)

    @property
    def baseline(self) -> float | None:
        return None if self._random is None else self._random.mean

    def begins(self, status: str) -> None:
        if self._ended == 0:
            self._logger.log_document("header", self.beginning(status))
            self._logger.flush()

    def beginning(self, status: str) -> str:
        return self._text(self._header.begins(status))

    def random_play(self, episodes: Sequence[Episode]) -> None:
        """Sets what the group is compared with, and logs it as an event."""
        self._random = played(episodes)
        self._now.random_play = self._random.mean
        self._logger.log_text(f"random play {self._in_words(self._random)}")

    def on_episode(self, episode: int, of_all: Mapping[str, Values], died: float | None) -> list[str]:
        """Logs the end of an episode in all replicas, at the logger's time; returns its events."""
        self._ended = episode + 1
        means = {name: mean_of(values) for name, values in of_all.items()}
        events = self._label(episode, means)
        if self._detector is not None:
            events += self._detector.add({name.removeprefix("social/"): mean for name, mean in means.items()})
        for event in events:
            self._logger.log_text(f"episode {episode:,}: {event}")
        if episode % -(-self._episodes // MOST_HEADERS) == 0 or self._ended == self._episodes:
            self._show_episode(died)
        return events

    def _show_episode(self, died: float | None) -> None:
        """Says in the header where the run is after an episode."""
        line = self._header.line(
            episode=self._ended,
            label=self._now.label,
            mean=self._now.mean,
            random_play=self.baseline,
            died=died,
        )
        self._document(line, of_mean=min(self._now.window, self._ended))

    def _label(self, episode: int, means: Mapping[str, float]) -> list[str]:
        """Takes the live label from the episode's means; the event if it changes."""
        value = means.get("social/collective_return")
        if value is None:
            value = sum(means.get(f"{agent}/return", 0.0) for agent in self._curves.agents)
        if not isfinite(value):
            return []
        epsilons = {name: mean for name, mean in means.items() if name.endswith("/epsilon")}
        before, label = self._now.label, self._now.add(value, epsilons)
        if label == before and not (episode == 0 and label == BEGINS):
            return []
        self._logger.log_states(_NOW, {episode: label})
        if label == BEGINS:
            return []
        ended = "exploration ends: no epsilon falls any more; " if before == EXPLORING else ""
        return [f"{ended}now {label}"]

    def finished(self, trained: Sequence[Episode], random: Sequence[Episode]) -> None:
        """Logs the evaluation of a run that is over, and its phases."""
        of_trained, of_random = played(trained), played(random)
        self._tell_phases()
        self._document(self._header.finished(of_trained, of_random))
        trained_words, random_words = self._in_words(of_trained), self._in_words(of_random)
        self._logger.log_text(f"finished: trained {trained_words}")
        self._logger.log_text(f"random play {random_words}")
        self._is_told = True

    def close(self) -> None:
        """Logs the end of a run that is over or was stopped, if `finished` did not."""
        if self._is_told:
            return
        if self._ended < self._episodes:
            self._document(self._header.stopped(self._ended, self._now.mean))
            return
        self._tell_phases()
        self._document(self._header.ended(self._now.mean))
        self._is_told = True

    def _tell_phases(self) -> None:
        if self._detector is None or not self._curves.has_phases:
            return
        labels = {round(phase.first): phase.label or ANOTHER for phase in self._detector.phases()}
        self._logger.log_states(_FOUND, labels)
        published = published_phases(self._game)
        within = {first: label for first, label in published.items() if first < self._ended}
        if within:
            self._logger.log_states(_PUBLISHED, within)
        self._logger.show_end()

    def _document(self, line: str, *, of_mean: int | None = None) -> None:
        self._logger.log_document("header", self._text(line, of_mean=of_mean))

    def _text(self, line: str, *, of_mean: int | None = None) -> str:
        return f"{line}\n\n{self._header.notes(window=self._window, of_mean=of_mean)}"

    def _in_words(self, numbers: Played) -> str:
        error = f" ± {numbers.error:.2g}" if isfinite(numbers.error) else ""
        died = "" if numbers.died is None else f", {numbers.died:,} boards died early"
        return (
            f"{numbers.mean:.1f}{error} {self._header.unit} in {numbers.episodes:,} fresh episodes (mean and "
            f"its standard error){died}"
        )

    def state_dict(self) -> dict[str, Any]:
        return {
            "now": self._now.state_dict(),
            "ended": self._ended,
            "events": None if self._detector is None else self._detector.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        if self._detector is not None and state["events"]:
            self._detector.load_state_dict(state["events"])
        self._now.load_state_dict(state["now"])
        self._ended = int(state["ended"])
        if self._ended:
            self._logger.log_states(_NOW, {self._ended - 1: self._now.label})
            self._show_episode(None)
            self._logger.flush()


def published_phases(game: Game | None) -> dict[int, str]:
    """The phases of the study's figures by the episode in which they begin; empty for another game."""
    if all(
        game != presets.game(board, variant=variant) for board, variant in presets.GAMES if board == "commons"
    ):
        return {}
    return dict(zip((0, *PHASES_BEGIN), PHASES, strict=True))
