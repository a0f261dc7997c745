"""The label of a running training, e.g. "rising", judged by its past alone: header and strip of the viewer.

Falls and recoveries have the thresholds of `cprl.measuring.outcome`, which judges a finished training.
"""

from collections import deque
from collections.abc import Mapping
from math import ceil, isfinite, isnan, nan
from statistics import fmean
from typing import Final

from cprl.measuring.outcome import PEAK_EPISODES, is_lost, is_regained
from cprl.measuring.windows import episodes_per_world

BEGINS: Final = "begins"
RISING: Final = "rising"
STEADY: Final = "steady"
FALLING: Final = "falling"
RECOVERING: Final = "recovering"
BELOW: Final = "below random play"
DEAD: Final = "dead"
EXPLORING: Final = "exploring"

RECENT_SHARE: Final = 0.1
"""The share of the episodes so far in the mean that labels a running training."""
RISEN_SHARE: Final = 0.1
"""The least relative increase of a mean that is rising."""
BELOW_RANDOM_SHARE: Final = 0.1
"""The relative distance below random play from which a running training is labelled as below it; larger than
at the end, since the mean is of few episodes."""
STILL_DEAD_SHARE: Final = 0.9
"""The least share of dying boards at which the label stays "dead" once it is set."""
EXPLORING_EPSILON: Final = 0.5
"""The epsilon above which agents explore even if it does not fall."""


class Course:
    """The live label of a running training, e.g. "rising", updated after each episode.

    With m the mean over the last 10 % of the episodes of each replica so far (at
    least 10), as a mean over replicas, p its peak since the last fall, low its lowest in a fall, and r the
    mean of random play:

    - begins: before each world has ended its part of 10 episodes;
    - dead: while m is below random play, from when all boards that m is a mean of died before the clock,
      until fewer than nine of ten do;
    - below random play: from m < r - 0.1 |r| on, until m >= r;
    - falling: from p - m >= (p - r) / 3 and p - m >= 0.15 p on;
    - recovering: after a fall, from m >= low + (p - low) / 4 on, until the next, or until m passes the
      highest peak;
    - rising: from the episode on in which m is a tenth above its first value, or above the last one of which
      that was true, while m was highest in one of the episodes that it is a mean of;
    - steady: else.

    Args:
        replicas: the replicas of the training; it is judged when all of them have ended W more episodes.
        worlds: the worlds W of each replica.
    """

    def __init__(self, replicas: int = 1, worlds: int = 1) -> None:
        self.random_play: float | None = None
        """The mean r of random play; None takes the first mean instead."""
        self.label = BEGINS
        self.mean = nan
        """The mean m after the last episode."""
        self.peak = nan
        """The highest mean m; NaN until there are enough episodes."""
        self.explores: bool | None = None
        """True if the epsilon of a learner falls, or is above 0.5; None while that is not known, and for
        learners without one."""
        self._worlds = worlds
        self._least_episodes = episodes_per_world(PEAK_EPISODES, worlds)
        self._waiting: list[deque[tuple[int, float, bool]]] = [deque() for _ in range(replicas)]
        """Episodes of each replica that the others have not ended."""
        self._recent: dict[tuple[int, int], _RecentEpisodes] = {}
        """The last episodes of each world, by replica and world."""
        self._rounds = 0
        """How often each replica has ended W episodes."""
        self._course = STEADY
        self._lowest_of_fall = self._peak_since_fall = self._first_mean = self._rising_level = nan
        self._peak_round = 0
        """The round with the highest mean m."""
        self._epsilons: dict[str, float] = {}

    def add(self, value: float, *, replica: int = 0, world: int = 0, has_died: bool | None = None) -> str:
        """Add an episode that a world has ended, and return the label.

        Args:
            value: what all agents got, e.g. the collective return; values that are not finite are left out.
            has_died: whether the board died before the clock; None for a game without stock.
        """
        self._waiting[replica].append((world, value, bool(has_died)))
        if all(len(ended) >= self._worlds for ended in self._waiting):
            self._add_round()
        return self.label

    def note_epsilons(self, epsilons: Mapping[str, float]) -> bool | None:
        """Judge by the epsilons of learners whether agents explore.

        Args:
            epsilons: the current epsilon of each learner that has one, by its name; NaN is left out.
        """
        finite = {name: float(epsilon) for name, epsilon in epsilons.items() if isfinite(epsilon)}
        if any(epsilon > EXPLORING_EPSILON for epsilon in finite.values()):
            self.explores = True
        elif self._epsilons and finite:
            self.explores = any(
                epsilon < self._epsilons.get(name, epsilon) for name, epsilon in finite.items()
            )
        self._epsilons |= finite
        return self.explores

    @property
    def _window(self) -> int:
        """Return how many episodes of each world m is a mean of."""
        return max(self._least_episodes, ceil(RECENT_SHARE * self._rounds))

    def _add_round(self) -> None:
        """Take W episodes of each replica, and judge."""
        self._rounds += 1
        for replica, ended in enumerate(self._waiting):
            for _ in range(self._worlds):
                world, value, has_died = ended.popleft()
                if isfinite(value):
                    last = self._recent.setdefault((replica, world), _RecentEpisodes())
                    last.add(value, has_died, most=self._window)
        recent = self._recent.values()
        if recent:
            self.mean = fmean(last.mean for last in recent)
        fewest = min(map(len, recent), default=0)
        if len(recent) == len(self._waiting) * self._worlds and fewest >= self._least_episodes:
            self._course = self._next_course(self._course)
            self.label = self._judge()

    def _judge(self) -> str:
        """Return the course, or "dead" or "below random play" while the mean is short of random play."""
        random = self.random_play
        if random is None:
            return self._course
        is_below = self.label in (BELOW, DEAD)
        margin = 0 if is_below else BELOW_RANDOM_SHARE * abs(random)
        if self.mean >= random - margin:
            return self._course
        recent = self._recent.values()
        died = sum(last.died for last in recent) / sum(map(len, recent))
        least = STILL_DEAD_SHARE if self.label == DEAD else 1
        return DEAD if died >= least else BELOW

    def _next_course(self, course: str) -> str:
        """Return the course after a round, and remember the peak, the lowest mean of a fall and the level
        from which a rise counts."""
        mean = self.mean
        self._note_peak(mean)
        is_highest = self._peak_round == self._rounds
        if course == FALLING:
            if self._is_still_falling(mean):
                return course
            self._peak_since_fall = mean
            course = RECOVERING
        self._peak_since_fall = max(self._peak_since_fall, mean)
        random = self._first_mean if self.random_play is None else self.random_play
        if is_lost(mean, peak=self._peak_since_fall, random=random):
            self._lowest_of_fall = mean
            return FALLING
        if course == RECOVERING:
            return RISING if is_highest else course
        if self._has_risen(mean):
            return RISING
        is_recent = self._rounds < self._peak_round + self._window
        return RISING if course == RISING and is_recent else STEADY

    def _note_peak(self, mean: float) -> None:
        """Remember a mean if it is the highest so far; the first one is also where all levels begin."""
        if isnan(self.peak):
            self.peak = self._peak_since_fall = self._first_mean = self._rising_level = mean
        if mean >= self.peak:
            self.peak = mean
            self._peak_round = self._rounds

    def _is_still_falling(self, mean: float) -> bool:
        """Return whether a fall goes on, and remember its lowest mean, above which a rise will count."""
        self._lowest_of_fall = min(self._lowest_of_fall, mean)
        self._rising_level = self._lowest_of_fall
        return not is_regained(mean, peak=self._peak_since_fall, low=self._lowest_of_fall)

    def _has_risen(self, mean: float) -> bool:
        """Return whether a mean is well above the last level that was a rise, and remember it if so."""
        has_risen = mean - self._rising_level > RISEN_SHARE * abs(self._rising_level)
        if has_risen:
            self._rising_level = mean
        return has_risen


class _RecentEpisodes:
    """The last episodes of a world: the mean of what agents got, and how many boards died."""

    def __init__(self) -> None:
        self._episodes: deque[tuple[float, bool]] = deque()
        self._sum = 0.0
        self.died = 0

    def __len__(self) -> int:
        return len(self._episodes)

    @property
    def mean(self) -> float:
        return self._sum / len(self._episodes)

    def add(self, value: float, has_died: bool, *, most: int) -> None:
        self._episodes.append((value, has_died))
        self._sum += value
        self.died += has_died
        while len(self._episodes) > most:
            earlier, had_died = self._episodes.popleft()
            self._sum -= earlier
            self.died -= had_died
