"""The texts of a recording: its header, the label that says how the group does, and events."""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import ceil, isnan, nan
from statistics import fmean
from threading import Event, Thread
from typing import Final, NamedTuple

import numpy as np
import rerun as rr

from cprl.measuring.live_label import BEGINS, EXPLORING, Course
from cprl.measuring.registry import COLLECTIVE_RETURN
from cprl.measuring.series import logged, mean_of
from cprl.measuring.statistics import Estimate, estimate_if_finite
from cprl.measuring.tracker import Episode
from cprl.measuring.windows import episodes_per_world
from cprl.system.defaults import LAST_EPISODES
from cprl.system.times import CLOCK
from cprl.viewer.frames import FrameSchedule
from cprl.viewer.logger import RerunLogger
from cprl.viewer.names import EXPLORATION_STRIP, LABEL_STRIP, SETTLED
from cprl.viewer.scene import Curves
from cprl.viewer.view import Numbers, View, has_died

_HARVEST: Final = logged(COLLECTIVE_RETURN)


class FreshResult(NamedTuple):
    """The result of episodes in fresh worlds, played without learning."""

    harvest: Estimate
    """The mean collective return in apples, with its interval over replicas. If the game reports no harvest,
    it is the mean of the summed returns. A single replica has no interval."""
    died: int | None
    """The number of episodes that ended early because no apple was left; None for a game without stock."""
    episodes: int
    """The number of episodes."""


def fresh_result(episodes: Sequence[Episode], *, replicas: int = 1) -> FreshResult:
    """Return the result of at least one episode in fresh worlds.

    Args:
        episodes: the same number of episodes for each replica, one replica after the other. If their number
            is no multiple of `replicas`, the result has no interval.
    """
    replicas = 1 if len(episodes) % replicas else replicas
    values = list(map(_income, episodes))
    harvest = estimate_if_finite(np.reshape(values, (replicas, -1)).mean(1).tolist())
    if COLLECTIVE_RETURN in episodes[0].metrics:
        harvest = harvest.bounded(COLLECTIVE_RETURN)
    died = [has_died(episode) for episode in episodes]
    deaths = None if None in died else sum(map(bool, died))
    return FreshResult(harvest=harvest, died=deaths, episodes=len(values))


def _income(episode: Episode) -> float:
    """Return the apples of all agents together, or their summed return if the game reports no harvest."""
    return float(episode.metrics.get(COLLECTIVE_RETURN, episode.return_.sum()))


@dataclass(frozen=True, kw_only=True)
class Header:
    """Writes the header of one run: a line of Markdown that says how the run does, and the plots' legend."""

    curves: Curves
    """The numbers that the recording plots."""
    episodes: int
    """The number of episodes of the run; an estimate if `is_about`."""
    rules: str = ""
    """The institutions in force, in words."""
    is_about: bool = False
    """Whether `episodes` is an estimate, because the run trains a number of steps."""

    @property
    def _total(self) -> str:
        return f"of {'about ' * self.is_about}{self.episodes:,}"

    def line(
        self, *, episode: int, label: str, mean: float, random_play: float | None, died: int | None
    ) -> str:
        """Return the header after an episode, or before the first has ended.

        Args:
            label: how the group does, e.g. "rising", or "compiling, 12 s so far".
            mean: the mean income of the last episodes; NaN before the first has ended.
            random_play: the mean income of random play.
            died: how many boards died early in the episode; None for a game without stock.
        """
        amounts = self.amounts({"": mean, "random play": random_play})
        deaths = _deaths(died, self.curves.replicas * self.curves.worlds)
        return self._text(f"Episode {episode:,} {self._total}", label, amounts, deaths)

    def finished(self, learning: float, trained: FreshResult, random: FreshResult) -> str:
        """Return the header after the evaluation of a run.

        Args:
            learning: the mean income at the end of the training.
            trained: the result of the trained agents in fresh worlds.
            random: the result of random play in fresh worlds.
        """
        amounts = {
            "while learning": learning,
            "trained": trained.harvest.value,
            "random play": random.harvest.value,
        }
        return self.ended(self.amounts(amounts), _deaths(trained.died, trained.episodes))

    def ended(self, *parts: str) -> str:
        """Return the header of a run that is over, with some further parts of the line."""
        length = "" if self.is_about else f", {self.episodes:,} episodes"
        return self._text(f"Finished{length}", *parts)

    def stopped(self, episode: int, mean: float) -> str:
        """Return the header of a run that was stopped after an episode; it can be resumed."""
        return self._text(f"Stopped after {episode:,} {self._total} episodes", self.amounts({"": mean}))

    def _text(self, *parts: str) -> str:
        line = f"#### {' · '.join(part for part in (*parts, self.rules) if part)}"
        return f"{line}\n\n{self.curves.legend}"

    def amounts(self, by_name: Mapping[str, float | None]) -> str:
        """Return incomes in words, e.g. "trained 100 apples, random play 282"; leave out None and NaN.

        Only the first income has the unit.
        """
        with_unit = "{} apples" if self.curves.unit == "apples" else f"{self.curves.unit} {{}}"
        texts: list[str] = []
        for name, value in by_name.items():
            if value is not None and not isnan(value):
                number = f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
                texts.append(f"{name} {number if texts else with_unit.format(number)}".strip())
        return ", ".join(texts)


def _deaths(died: int | None, boards: int) -> str:
    if died is None:
        return ""
    if boards == 1:
        return "the board died early" if died else ""
    return f"{died:,} of {boards:,} boards died early"


class BestTracker:
    """Notices when the mean harvest clearly exceeds the best mean so far."""

    LEAST_EPISODES = 50
    """The smallest number of episodes over which a mean is compared with the best."""
    LEAST_RATIO = 1.05
    """The smallest ratio of a new best to the last one."""

    def __init__(self, worlds: int) -> None:
        self._worlds = worlds
        self._apples: list[float] = []
        self._best = 0.0

    def add(self, apples: float) -> str:
        """Add the mean harvest of one block of W episodes; return a new best in words, or ""."""
        self._apples.append(apples)
        count = ceil(self.LEAST_EPISODES / self._worlds)
        if len(self._apples) < count:
            return ""
        mean = float(np.mean(self._apples))
        self._apples.clear()
        if not mean > self.LEAST_RATIO * self._best:
            return ""
        self._best = mean
        return f"new best: {mean:.1f} apples per episode, mean of the last {count * self._worlds}"


_MOST_HEADERS: Final = 5000
"""About the largest number of headers in a recording; in longer runs only every k-th episode has one."""


class HeaderView(View):
    """Logs the header, the label that says how the group does, and events such as a new best.

    Args:
        schedule: decides which episodes are recorded; the view adds the episode after each new best.
    """

    def __init__(self, logger: RerunLogger, schedule: FrameSchedule, header: Header) -> None:
        self._logger = logger
        self._schedule = schedule
        self._curves = logger.curves
        self.header = header
        self.course = Course(self._curves.replicas, self._curves.worlds)
        self._label = BEGINS
        self._bests = BestTracker(self._curves.worlds)
        self._random_result: FreshResult | None = None
        self._ended = 0
        """The number of episodes that all replicas have ended."""
        self._deaths: dict[int, int] = {}
        """The boards that died early, counted in each block of W episodes that some replica still plays."""
        self._last_incomes: dict[tuple[int, int], deque[float]] = {}
        """The incomes of the last episodes, by replica and world."""
        self._is_over = False
        # For viewers only: in the file of a resumed run this label would follow those of the earlier files.
        logger.log_row(LABEL_STRIP, rr.StateChange(state=BEGINS), live_only=True)
        logger.log_header(self._line(BEGINS))
        logger.flush()

    def random_play(self, episodes: Sequence[Episode]) -> None:
        """Compare the group with random play, and log its result as an event."""
        self._random_result = fresh_result(episodes, replicas=self._curves.replicas)
        self.course.random_play = self._random_result.harvest.value
        self._logger.log_text(f"random play {self._describe(self._random_result)}")
        self.begins(BEGINS)

    def begins(self, status: str) -> None:
        """Show a status in the live header, e.g. "compiling, 12 s so far", unless an episode has ended."""
        if not self._ended:
            self._logger.show_header(self._line(status))

    def change_rules(self, rules: str) -> None:
        """Name other institutions in the header from now on."""
        self.header = replace(self.header, rules=rules)
        if not self._ended:
            self._logger.log_header(self._line(BEGINS))

    def on_episode(self, episode: Episode) -> None:
        income = _income(episode)
        died = has_died(episode)
        self.course.add(income, replica=episode.replica, world=episode.world, has_died=died)
        kept = episodes_per_world(LAST_EPISODES, self._curves.worlds)
        self._last_incomes.setdefault((episode.replica, episode.world), deque(maxlen=kept)).append(income)
        if died is not None:
            block = episode.episode // self._curves.worlds
            self._deaths[block] = self._deaths.get(block, 0) + died

    def on_numbers(self, episode: int, numbers: Numbers) -> None:
        ended_before = self._ended
        self._ended = episode + 1
        died = self._deaths.pop(episode // self._curves.worlds, None)
        means = {name: mean_of(values) for name, values in numbers.items()}
        for event in (self._update_exploration(means), self._update_label(episode), self._update_best(means)):
            if event:
                self._logger.log_text(f"episode {episode:,}: {event}")
        period = ceil(self.header.episodes / _MOST_HEADERS)
        is_due = ceil(self._ended / period) > ceil(ended_before / period)
        if is_due or self._ended == self.header.episodes:
            self._show_episode(died)

    def _update_exploration(self, means: Mapping[str, float]) -> str:
        """Log whether agents explore, if that has changed; return the end of exploration in words, or ""."""
        explored = self.course.explores
        epsilons = {name: mean for name, mean in means.items() if name.endswith("/epsilon")}
        explores = self.course.note_epsilons(epsilons)
        if explores == explored:
            return ""
        state = EXPLORING if explores else SETTLED
        self._logger.log_row(EXPLORATION_STRIP, rr.StateChange(state=state))
        return "exploration ends: no epsilon falls any more" if explored else ""

    def _update_label(self, episode: int) -> str:
        """Log the label of the group if it has changed, and at first; return a new label in words, or ""."""
        label = self.course.label
        is_new = label != self._label
        if is_new or episode < self._curves.worlds:
            self._logger.log_row(LABEL_STRIP, rr.StateChange(state=label))
        self._label = label
        return f"now {label}" if is_new else ""

    def _update_best(self, means: Mapping[str, float]) -> str:
        """Record the running episode if there is a new best; return the best in words, or ""."""
        best = self._bests.add(means[_HARVEST]) if _HARVEST in means else ""
        if best:
            self._schedule.show()
        return best

    def resumed(self) -> None:
        """Show the state of a run that is resumed."""
        if self._ended:
            self._logger.log_row(LABEL_STRIP, rr.StateChange(state=self._label))
            self._show_episode(None)
            self._logger.flush()

    def _show_episode(self, died: int | None) -> None:
        """Show the state of the run after an episode in the header."""
        label = self._label
        if self.course.explores:
            label += f", {EXPLORING}"
        self._logger.log_header(self._line(label, died))

    def _line(self, label: str, died: int | None = None) -> str:
        return self.header.line(
            episode=max(1, self._ended),
            label=label,
            mean=self.course.mean,
            random_play=self.course.random_play,
            died=died,
        )

    @property
    def _learning(self) -> float:
        """Return the mean income at the end of the training; NaN before the first episode has ended.

        Each world counts with the same number of its last episodes, as in the terminal's summary.
        """
        shared = min(map(len, self._last_incomes.values()), default=0)
        if not shared:
            return nan
        return fmean(income for incomes in self._last_incomes.values() for income in list(incomes)[-shared:])

    def finished(self, played_by: Mapping[str, Sequence[Episode]]) -> None:
        """Log the evaluation of a run that is over."""
        replicas = self._curves.replicas
        trained = fresh_result(played_by["trained"], replicas=replicas)
        random = fresh_result(played_by["random"], replicas=replicas)
        self._is_over = True
        self._logger.log_header(self.header.finished(self._learning, trained, random))
        self._logger.log_text(f"finished: trained {self._describe(trained)}")

    def close(self) -> None:
        """Log the end of a run that is over or was stopped, if `finished` did not."""
        if self._is_over:
            return
        self._is_over = True
        header = self.header.ended(f"{self.header.amounts({'': self._learning})} at the end")
        if self._ended + self._curves.worlds <= self.header.episodes and not self.header.is_about:
            header = self.header.stopped(self._ended, self.course.mean)
        self._logger.log_header(header)

    def _describe(self, result: FreshResult) -> str:
        harvest = f"{result.harvest} {self._curves.unit}"
        return "; ".join(filter(None, (harvest, _deaths(result.died, result.episodes))))


class Events(View):
    """Logs events of the first world: the effects of institutions, and when the last apple was taken.

    The last apple is an event in each recorded episode, and the first time that it is taken.

    Args:
        every: the number of episodes of this world between two events about institutions.
    """

    def __init__(self, logger: RerunLogger, schedule: FrameSchedule, *, every: int) -> None:
        self._logger = logger
        self._schedule = schedule
        self._every = every
        self._has_seen_death = False
        self._ended = 0

    def on_episode(self, episode: Episode) -> None:
        if episode.world:
            return
        event = ""
        if self._ended % self._every == 0:
            event = describe_institutions(episode, self._logger.curves)
        self._ended += 1
        if event:
            self._logger.log_text(f"episode {episode.episode:,}: {event}")
        step = episode.depletion_step or -1
        if step > 0 and (self._schedule.was_on or not self._has_seen_death):
            self._logger.log_text(f"episode {episode.episode:,}: last apple taken in step {step}")
            self._has_seen_death = True


_MOST_LISTED: Final = 6
"""The largest number of agents whose fines an event lists one by one."""


def describe_institutions(episode: Episode, curves: Curves) -> str:
    """Return the decisions, violations and fines of an episode in words, e.g. "3 violations; fined 0, 1.5".

    Return "" if there were none.
    """
    parts = []
    if episode.in_force is not None:
        decided = zip(curves.in_force, episode.in_force, strict=False)
        parts.append(", ".join(f"{title}: {value:g}" for title, value in decided))
    if episode.violations is not None and episode.violations.any():
        count = int(episode.violations.sum())
        parts.append(f"{count:,} violation{'s' * (count > 1)}")
    if episode.fines is not None and episode.fines.any():
        amounts = ", ".join(f"{fine:.4g}" for fine in episode.fines)
        if len(episode.fines) > _MOST_LISTED:
            amounts = f"{episode.fines.sum():.4g} in all"
        parts.append(f"fined {amounts}")
    return "; ".join(filter(None, parts))


class CompilingNotice(View):
    """Reports in a separate thread, once a second, for how long code has been compiled.

    It ends with the first episode, or when it is closed.

    Args:
        show: called from that thread with "compiling, 12 s so far", and with "begins" when compiling is over.
    """

    PERIOD_S = 1.0
    """Seconds between two reports."""

    def __init__(self, show: Callable[[str], object]) -> None:
        self._show = show
        self._is_closed = Event()
        self._earlier_s = CLOCK.total_s
        """The seconds of compiling before this training."""
        Thread(target=self._watch, daemon=True, name="cprl compiling").start()

    def on_numbers(self, episode: int, numbers: Numbers) -> None:
        self.close()

    def close(self) -> None:
        self._is_closed.set()

    def _watch(self) -> None:
        was_running = False
        while not self._is_closed.wait(self.PERIOD_S):
            is_running = CLOCK.is_running  # read once, because another thread changes it
            if is_running:
                self._show(f"compiling, {CLOCK.total_s - self._earlier_s:.0f} s so far")
            elif was_running:
                self._show("begins")
            was_running = is_running
