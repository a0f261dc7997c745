"""Story: the header, the live label, events, and at the end the phases of a training."""

from collections.abc import Mapping, Sequence
from math import isfinite
from typing import Any, Final

from cprl import presets
from cprl.commons.game import Game
from cprl.measuring.episodes import Episode
from cprl.measuring.now import BEGINS, EXPLORING, Now
from cprl.measuring.phases import METRICS, PHASES
from cprl.measuring.published import PHASES_BEGIN
from cprl.measuring.series import Values, mean_of
from cprl.viewer.events import EventDetector
from cprl.viewer.header import Header, Played, played
from cprl.viewer.logger import RerunLogger
from cprl.viewer.scenery import ANOTHER, STRIPS, Curves

MOST_HEADERS: Final = 5000
"""Rows of the header in a recording, about; in longer runs some episodes have none of their own."""

_NOW, _FOUND, _PUBLISHED = STRIPS


class Story:
    """Logs what people read first: where the run is, what the group does, and what came of it.

    Args:
        logger: where it is logged.
        curves: what is plotted.
        episodes: of the run.
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
        """The mean of random play, once it is known."""
        return None if self._random is None else self._random.mean

    def begins(self, status: str) -> None:
        """Says in the header what happens before the first episode has ended, e.g. "begins"."""
        if self._ended == 0:
            self._logger.log_document("header", self.beginning(status))
            self._logger.flush()

    def beginning(self, status: str) -> str:
        """The header before the first episode has ended."""
        return self._text(self._header.begins(status))

    def random_play(self, episodes: Sequence[Episode]) -> None:
        """Sets what the group is compared with, and logs it as an event."""
        self._random = played(episodes)
        self._now.random_play = self._random.mean
        self._logger.log_text(f"random play {self._in_words(self._random)}")

    def on_episode(self, episode: int, of_all: Mapping[str, Values], died: float | None) -> list[str]:
        """Logs the end of an episode in all replicas, at the logger's time; returns its events.

        Args:
            episode: its number, from 0 on.
            of_all: its numbers, [R] by name.
            died: boards that died early; None for a game that reports no stock.
        """
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
        found = {round(one.first): one.label or ANOTHER for one in self._detector.phases()}
        self._logger.log_states(_FOUND, found)
        published = published_phases(self._game)
        within = {first: label for first, label in published.items() if first < self._ended}
        if within:
            self._logger.log_states(_PUBLISHED, within)
        self._logger.show_end()

    def _document(self, line: str, *, of_mean: int | None = None) -> None:
        self._logger.log_document("header", self._text(line, of_mean=of_mean))

    def _text(self, line: str, *, of_mean: int | None = None) -> str:
        return f"{line}\n\n{self._header.notes(window=self._window, of_mean=of_mean)}"

    def _in_words(self, own: Played) -> str:
        error = f" ± {own.error:.2g}" if isfinite(own.error) else ""
        died = "" if own.died is None else f", {own.died:,} boards died early"
        return (
            f"{own.mean:.1f}{error} {self._header.unit} in {own.episodes:,} fresh episodes (mean and its "
            f"standard error){died}"
        )

    def state_dict(self) -> dict[str, Any]:
        """The label and the events so far."""
        return {
            "now": self._now.state_dict(),
            "ended": self._ended,
            "events": None if self._detector is None else self._detector.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from a state that `state_dict` returned."""
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
    if all(game != presets.game(board, variant=own) for board, own in presets.GAMES if board == "commons"):
        return {}
    return dict(zip((0, *PHASES_BEGIN), PHASES, strict=True))
