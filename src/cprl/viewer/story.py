"""Story: the header, the live label, and events of a training."""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import ceil, isnan, nan
from statistics import fmean
from threading import Event, Thread
from typing import Final, NamedTuple

import numpy as np
import rerun as rr

from cprl.measuring.episodes import Episode
from cprl.measuring.outcome import BEGINS, EXPLORING, Course
from cprl.measuring.registry import COLLECTIVE_RETURN
from cprl.measuring.series import logged, mean_of
from cprl.measuring.statistics import Estimate, estimate_if_finite
from cprl.measuring.windows import LAST_EPISODES, rounds_of
from cprl.system.times import CLOCK
from cprl.values.arrays import Float64
from cprl.viewer import names
from cprl.viewer.frames import Filming
from cprl.viewer.logger import RerunLogger
from cprl.viewer.names import HEADER, SETTLED
from cprl.viewer.scene import Curves
from cprl.viewer.views import View, has_died

HARVEST: Final = logged(COLLECTIVE_RETURN)


class Played(NamedTuple):
    """Episodes in fresh worlds, in numbers."""

    harvest: Estimate
    """The mean collective return in apples, or where the game reports no harvest the mean summed return, with
    its interval over replicas; that of a single replica has none."""
    died: int | None
    """Episodes whose board died before the time was up; None where the game reports no stock."""
    episodes: int


def played(episodes: Sequence[Episode], *, replicas: int = 1) -> Played:
    """Return the numbers of at least one episode in fresh worlds, equally many of each replica, one replica
    after the other; of any other number the mean alone."""
    replicas = 1 if len(episodes) % replicas else replicas
    values = list(map(_gained, episodes))
    harvest = estimate_if_finite(np.reshape(values, (replicas, -1)).mean(1).tolist())
    died = [has_died(episode) for episode in episodes]
    return Played(
        harvest=harvest.of(COLLECTIVE_RETURN) if COLLECTIVE_RETURN in episodes[0].metrics else harvest,
        died=None if None in died else sum(map(bool, died)),
        episodes=len(values),
    )


def _gained(episode: Episode) -> float:
    """Return what all agents got together: apples, or the return where the game reports no harvest."""
    return float(episode.metrics.get(COLLECTIVE_RETURN, episode.return_.sum()))


@dataclass(frozen=True, kw_only=True)
class Header:
    """The headers of one run: a line of Markdown each."""

    curves: Curves
    episodes: int
    """Of the run, or about as many where it trains so many steps."""
    rules: str = ""
    """The institutions in force, in words."""
    is_about: bool = False
    """Whether it trains so many steps."""

    @property
    def _of(self) -> str:
        return f"of {'about ' * self.is_about}{self.episodes:,}"

    def begins(self, status: str, random_play: float | None = None) -> str:
        return self._text(f"Episode 1 {self._of}", status, self.amounts({"random play": random_play}))

    def line(
        self, *, episode: int, label: str, mean: float, random_play: float | None, died: int | None
    ) -> str:
        """Return the header after an episode, in which so many boards died early; None for a game without
        stock."""
        amounts = self.amounts({"": mean, "random play": random_play})
        deaths = _deaths(died, self.curves.replicas * self.curves.worlds)
        return self._text(f"Episode {episode:,} {self._of}", label, amounts, deaths)

    def finished(self, learning: float, trained: Played, random: Played) -> str:
        """Return the header after the evaluation of a run: what agents got at the end of its training, and in
        fresh worlds the trained policy, which explores less there, and random play."""
        amounts = {
            "while learning": learning,
            "trained": trained.harvest.value,
            "random play": random.harvest.value,
        }
        return self.ended(self.amounts(amounts), _deaths(trained.died, trained.episodes))

    def ended(self, *parts: str) -> str:
        return self._text("Finished" if self.is_about else f"Finished, {self.episodes:,} episodes", *parts)

    def stopped(self, episode: int, mean: float) -> str:
        """Return the header of a run that was stopped after so many episodes; it can be resumed."""
        return self._text(f"Stopped after {episode:,} {self._of} episodes", self.amounts({"": mean}))

    def _text(self, *parts: str) -> str:
        line = f"#### {' · '.join(part for part in (*parts, self.rules) if part)}"
        return f"{line}\n\n{self.curves.legend}"

    def amounts(self, by_name: Mapping[str, float | None]) -> str:
        """Return what agents got, e.g. "trained 100 apples, random play 282"; None and NaN are left out."""
        form = "{} apples" if self.curves.unit == "apples" else f"{self.curves.unit} {{}}"
        texts: list[str] = []
        for name, value in by_name.items():
            if value is not None and not isnan(value):
                number = f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
                texts.append(f"{name} {number if texts else form.format(number)}".strip())
        return ", ".join(texts)


def _deaths(died: int | None, boards: int) -> str:
    if died is None:
        return ""
    if boards == 1:
        return "the board died early" if died else ""
    return f"{died:,} of {boards:,} boards died early"


class Bests:
    """Tells when agents harvest clearly more than ever before, as a mean over replicas and episodes."""

    OVER = 50
    """Episodes of the mean that is compared with the best, at least."""
    BETTER = 1.05
    """The factor by which a new best must exceed the last reported one."""

    def __init__(self, worlds: int = 1) -> None:
        self._worlds = worlds
        self._apples: list[float] = []
        self._best = 0.0

    def add(self, apples: float) -> str | None:
        """Add the mean harvest of an episode, or of W; return a new best in words if it is one."""
        self._apples.append(apples)
        count = ceil(self.OVER / self._worlds)
        if len(self._apples) < count:
            return None
        reached = float(np.mean(self._apples))
        self._apples.clear()
        if not reached > self.BETTER * self._best:
            return None
        self._best = reached
        return f"new best: {reached:.1f} apples per episode, mean of the last {count * self._worlds}"


MOST_HEADERS: Final = 5000
"""Rows of the header in a recording, about; in longer runs some episodes have none of their own."""


class Story(View):
    """Logs what people read first: where the run is, what the group does, and what it achieved.

    Args:
        filming: which episodes are recorded; that after a new best is.
        header: what it says above the board.
    """

    def __init__(self, logger: RerunLogger, filming: Filming, header: Header) -> None:
        self._logger = logger
        self._filming = filming
        self._curves = logger.curves
        self.header = header
        self.course = Course(self._curves.replicas, self._curves.worlds)
        self._label = BEGINS
        self._bests = Bests(self._curves.worlds)
        self._random: Played | None = None
        self._ended = 0
        self._died: dict[int, int] = {}
        """How many boards died early, by the episode in their world, until all have ended it."""
        self._last: dict[tuple[int, int], deque[float]] = {}
        """What all agents got in the last episodes of each world of each replica."""
        self._is_over = False
        # A file of a resumed run must not say so: it is shown with those before it.
        logger.log_row(names.NOW, rr.StateChange(state=BEGINS), live_only=True)
        logger.log_document(HEADER, self.header.begins("begins"))
        logger.flush()

    def random_play(self, episodes: Sequence[Episode]) -> None:
        """Set what the group is compared with, and log it as an event."""
        self._random = played(episodes, replicas=self._curves.replicas)
        self.course.random_play = self._random.harvest.value
        self._logger.log_text(f"random play {self._in_words(self._random)}")
        if not self._ended:
            self.begins(BEGINS)

    def begins(self, status: str) -> None:
        """Say live what is done before the first episode ends, e.g. "compiling, 12 s so far"."""
        self._logger.show_live(HEADER, self.header.begins(status, self.course.random_play))

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        of_world = episode.replica, episode.world
        gained = _gained(episode)
        died = has_died(episode)
        self.course.add(gained, replica=episode.replica, world=episode.world, has_died=died)
        each = rounds_of(LAST_EPISODES, self._curves.worlds)
        self._last.setdefault(of_world, deque(maxlen=each)).append(gained)
        if died is not None:
            together = episode.episode // self._curves.worlds
            self._died[together] = self._died.get(together, 0) + died

    def on_numbers(self, episode: int, numbers: Mapping[str, Float64]) -> None:
        before = self._ended
        self._ended = episode + 1
        died = self._died.pop(episode // self._curves.worlds, None)
        events = self._look(episode, {name: mean_of(values) for name, values in numbers.items()})
        for event in events:
            self._logger.log_text(f"episode {episode:,}: {event}")
        apart = -(-self.header.episodes // MOST_HEADERS)
        if -(-self._ended // apart) > -(-before // apart) or self._ended == self.header.episodes:
            self._show_episode(died)

    def _look(self, episode: int, means: Mapping[str, float]) -> list[str]:
        """Log the live label, and whether agents explore, where an episode changes them; return what is
        new in words."""
        events = []
        explored = self.course.explores
        explores = self.course.explore(
            {name: mean for name, mean in means.items() if name.endswith("/epsilon")}
        )
        if explores != explored:
            state = EXPLORING if explores else SETTLED
            self._logger.log_row(names.EXPLORING, rr.StateChange(state=state))
            if explored:
                events.append("exploration ends: no epsilon falls any more")
        label = self.course.label
        if label != self._label or episode < self._curves.worlds:
            self._logger.log_row(names.NOW, rr.StateChange(state=label))
        if label != self._label:
            events.append(f"now {label}")
            self._label = label
        best = self._bests.add(means[HARVEST]) if HARVEST in means else None
        if best is not None:
            events.append(best)
            self._filming.show()
        return events

    def resumed(self) -> None:
        """Show where a run is that goes on after the episodes so far."""
        if self._ended:
            self._logger.log_row(names.NOW, rr.StateChange(state=self._label))
            self._show_episode(None)
            self._logger.flush()

    def _show_episode(self, died: int | None) -> None:
        """Say in the header where the run is after an episode."""
        text = self.header.line(
            episode=self._ended,
            label=f"{self._label}, {EXPLORING}" if self.course.explores else self._label,
            mean=self.course.mean,
            random_play=self.course.random_play,
            died=died,
        )
        self._logger.log_document(HEADER, text)

    @property
    def _learning(self) -> float:
        """What all agents got at the end of the training, as the terminal says it: in as many of the
        last episodes of each world."""
        each = min(map(len, self._last.values()), default=0)
        return fmean(value for last in self._last.values() for value in list(last)[-each:]) if each else nan

    def finished(self, played_by: Mapping[str, Sequence[Episode]]) -> None:
        """Log the evaluation of a run that is over."""
        replicas = self._curves.replicas
        trained = played(played_by["trained"], replicas=replicas)
        random = played(played_by["random"], replicas=replicas)
        self._is_over = True
        self._logger.log_document(HEADER, self.header.finished(self._learning, trained, random))
        self._logger.log_text(f"finished: trained {self._in_words(trained)}")

    def close(self) -> None:
        """Log the end of a run that is over or was stopped, if `finished` did not."""
        if self._is_over:
            return
        self._is_over = True
        header = self.header.ended(f"{self.header.amounts({'': self._learning})} at the end")
        if self._ended + self._curves.worlds <= self.header.episodes and not self.header.is_about:
            header = self.header.stopped(self._ended, self.course.mean)
        self._logger.log_document(HEADER, header)

    def _in_words(self, numbers: Played) -> str:
        died = "" if numbers.died is None else f"; {numbers.died:,} of {numbers.episodes:,} boards died early"
        return f"{numbers.harvest} {self._curves.unit}{died}"


class Events(View):
    """Logs what institutions did in an episode of the first world now and then, and its last apple, for the
    first time and where one sees it.

    Args:
        every: episodes of that world from one event about institutions to the next.
    """

    def __init__(self, logger: RerunLogger, filming: Filming, *, every: int) -> None:
        self._logger = logger
        self._filming = filming
        self._every = every
        self._has_seen_death = False
        self._ended = 0

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        if episode.world:
            return
        number = self._ended
        self._ended = self._ended + 1
        words = in_words(episode, self._logger.curves) if number % self._every == 0 else ""
        if words:
            self._logger.log_text(f"episode {episode.episode:,}: {words}")
        step = episode.depletion_step or -1
        if step > 0 and (self._filming.was_on or not self._has_seen_death):
            self._logger.log_text(f"episode {episode.episode:,}: last apple taken in step {step}")
            self._has_seen_death = True


_FEW: Final = 6
"""Agents whose fines fit one event."""


def in_words(episode: Episode, curves: Curves) -> str:
    """Return what was decided, broken and paid in an episode, e.g. "3 violations; fined 0, 1.5"; "" for
    nothing."""
    parts = []
    if episode.in_force is not None:
        decided = zip(curves.in_force, episode.in_force, strict=False)
        parts.append(", ".join(f"{title}: {value:g}" for title, value in decided))
    if episode.violations is not None and episode.violations.any():
        broken = int(episode.violations.sum())
        parts.append(f"{broken:,} violation{'s' * (broken > 1)}")
    if episode.fines is not None and episode.fines.any():
        each = [f"{fine:.4g}" for fine in episode.fines.tolist()]
        parts.append(f"fined {', '.join(each) if len(each) <= _FEW else f'{episode.fines.sum():.4g} in all'}")
    return "; ".join(part for part in parts if part)


class CompilingNotice(View):
    """Calls a function once a second while code is compiled, in a thread of its own, until it is closed.

    Args:
        show: called with "compiling, 12 s so far", and with "begins" once nothing is compiled any more; from
            another thread.
    """

    PERIOD_S = 1.0

    def __init__(self, show: Callable[[str], object]) -> None:
        self._show = show
        self._over = Event()
        self._before_s = CLOCK.total_s
        Thread(target=self._watch, daemon=True, name="cprl compiling").start()

    def on_numbers(self, episode: int, numbers: Mapping[str, Float64]) -> None:
        self.close()

    def close(self) -> None:
        self._over.set()

    def _watch(self) -> None:
        was_running = False
        while not self._over.wait(self.PERIOD_S):
            is_running = CLOCK.is_running  # once: it may end in between
            if is_running:
                self._show(f"compiling, {CLOCK.total_s - self._before_s:.0f} s so far")
            elif was_running:
                self._show("begins")
            was_running = is_running
