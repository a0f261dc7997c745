"""The label of a running training and the outcome of a finished one, with the same words and thresholds.

Course       what a group of learners does at the moment, judged by its past alone: header and strip
Outcome      how a training went, judged by the whole of it: sentences, tables of studies, reports

"The mean of n episodes" of a replica in W worlds is that of the last ceil(n / W) episodes of each world, so
that worlds count alike. Those that ended last, of all worlds, would be the longest ones.
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from math import ceil, isfinite, isnan, nan
from statistics import fmean
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from cprl.measuring.table import gain_metric, where, world_of
from cprl.measuring.windows import episodes_per_world, mean_of_worlds
from cprl.system.defaults import LAST_EPISODES
from cprl.values.array_types import Float64

BEGINS: Final = "begins"
RISING: Final = "rising"
STEADY: Final = "steady"
FALLING: Final = "falling"
RECOVERING: Final = "recovering"
BELOW: Final = "below random play"
DEAD: Final = "dead"
EXPLORING: Final = "exploring"

NO_BETTER: Final = "no better"
HARVESTING: Final = "harvesting"
DECLINE: Final = "decline"
RECOVERY: Final = "recovery"
TRAGEDY: Final = "tragedy"

PEAK_EPISODES: Final = 10
"""Episodes of the mean whose highest value is the peak of a training; with fewer, nothing is judged."""
RECENT_SHARE: Final = 0.1
"""The share of the episodes so far in the mean that labels a running training."""
LEARNED_FACTOR: Final = 1.5
"""The least ratio of the peak to random play if agents have learned something."""
LOST_SHARE: Final = 1 / 3
"""The least share of the peak's lead over random play that a fall loses."""
LEAST_LOSS_SHARE: Final = 0.15
"""The least share of the peak that a fall loses, however small its lead over random play."""
REGAINED_SHARE: Final = 1 / 4
"""The least share of the loss that a recovery regains."""
RISEN_SHARE: Final = 0.1
"""The least relative increase of a mean that is rising."""
BELOW_RANDOM_FACTOR: Final = 0.95
"""The highest ratio of the last episodes to random play in a tragedy."""
SHORT_SHARE: Final = 0.1
"""The relative distance below random play from which a running training is labelled as below it; larger than
at the end, since the mean is of few episodes."""
LIVED_SHARE: Final = 0.7
"""The longest mean life of boards in a tragedy, as a share of the longest life."""
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
        self._lowest = self._peak_since_fall = self._first_mean = self._rising_level = nan
        self._highest = 0
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

    def explore(self, epsilons: Mapping[str, float]) -> bool | None:
        """Judge whether agents explore.

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
        random = self.random_play
        if random is None:
            return self._course
        is_below = self.label in (BELOW, DEAD)
        lead = 0 if is_below else SHORT_SHARE * abs(random)
        if self.mean >= random - lead:
            return self._course
        recent = self._recent.values()
        died = sum(last.died for last in recent) / sum(map(len, recent))
        least = STILL_DEAD_SHARE if self.label == DEAD else 1
        return DEAD if died >= least else BELOW

    def _next_course(self, course: str) -> str:
        """Return the course after a round. `_peak_since_fall` is p, and `_lowest` the lowest mean of a
        fall."""
        mean = self.mean
        if isnan(self.peak):
            self.peak = self._peak_since_fall = self._first_mean = self._rising_level = mean
        is_highest = mean >= self.peak
        if is_highest:
            self.peak = mean
            self._highest = self._rounds
        if course == FALLING:
            self._lowest = min(self._lowest, mean)
            self._rising_level = self._lowest
            if not is_regained(mean, peak=self._peak_since_fall, low=self._lowest):
                return course
            self._peak_since_fall = mean
            course = RECOVERING
        self._peak_since_fall = max(self._peak_since_fall, mean)
        random = self._first_mean if self.random_play is None else self.random_play
        if is_lost(mean, peak=self._peak_since_fall, random=random):
            self._lowest = mean
            return FALLING
        if course == RECOVERING:
            return RISING if is_highest else course
        if mean - self._rising_level > RISEN_SHARE * abs(self._rising_level):
            self._rising_level = mean
            return RISING
        is_recent = self._rounds < self._highest + self._window
        return RISING if course == RISING and is_recent else STEADY


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


def is_lost(mean: float, *, peak: float, random: float) -> bool:
    """Return whether a mean has fallen from a peak."""
    loss = peak - mean
    return loss > 0 and loss >= LOST_SHARE * (peak - random) and loss >= LEAST_LOSS_SHARE * abs(peak)


def is_regained(mean: float, *, peak: float, low: float) -> bool:
    """Return whether a mean has recovered from the lowest one of a fall."""
    return mean >= low + REGAINED_SHARE * (peak - low)


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """The outcome of the training of one replica, or of several, whose means are then means over replicas."""

    begins: float
    """The mean of what all agents got in the first 10 episodes."""
    peak: float
    """The highest mean of 10 episodes."""
    around: int
    """The episode in the middle of those of the peak, counted from 1."""
    low: float
    """The lowest mean of 30 episodes from the peak on."""
    last: float
    """The mean of the last 30 episodes."""
    lived: float
    """The mean life of boards in the last 30 episodes, as a share of the longest life in the training."""
    random: float
    """The mean of what agents who act at random get."""
    agents: int

    @property
    def word(self) -> str:
        """Return the word for the outcome.

        - no better: the peak is below 1.5 times random play;
        - recovery: a fall, of a third of the peak's lead over random play and 15 % of the peak, of which a
          quarter is regained at the end;
        - tragedy: at the end several agents get at most 95 % of random play, and their boards last at most
          70 % of the steps that they could;
        - decline: a fall that is not regained, or an end below random play that is no tragedy;
        - harvesting: else.

        A tragedy in the sense of G. Hardin, "The tragedy of the commons" (1968): each of several has learned
        to take what pays, and what they share is ruined, so that all get less than if nobody had learned.
        That it is learned is why the peak is well above random play; that it is the ruin of a board, and no
        mere fall, why boards have to die. The numbers are ours; factors of a negative random play, as of
        incomes without a harvest, are as far above or below it. Whether the difference is more than chance is
        another question, which intervals over replicas answer.
        """
        if self.peak < self.random + (LEARNED_FACTOR - 1) * abs(self.random):
            return NO_BETTER
        has_fallen = is_lost(self.low, peak=self.peak, random=self.random)
        if has_fallen and is_regained(self.last, peak=self.peak, low=self.low):
            return RECOVERY
        if self.last <= self.random - (1 - BELOW_RANDOM_FACTOR) * abs(self.random):
            is_ruin = self.agents > 1 and self.lived <= LIVED_SHARE
            return TRAGEDY if is_ruin else DECLINE
        return DECLINE if is_lost(self.last, peak=self.peak, random=self.random) else HARVESTING


RULE: Final = (
    f"its last {LAST_EPISODES} episodes against its peak and random play ({NO_BETTER}: no mean of "
    f"{PEAK_EPISODES} episodes reached {LEARNED_FACTOR} times random play; {TRAGEDY}: several agents get at "
    f"most {BELOW_RANDOM_FACTOR:.0%} of random play, and boards last at most {LIVED_SHARE:.0%} of the "
    "longest life)"
)
"""The rule of the word, as tables explain it."""


def outcome_of(table: pa.Table, *, random: float) -> Outcome:
    """Return the outcome of a training, of one replica or over several.

    Args:
        table: its episodes, those of each replica in the order in which they ended.
        random: the mean of what agents who act at random get.
    """
    rows = where(table, agent=0)
    replicas = [where(rows, replica=replica) for replica in rows["replica"].unique().to_pylist()]
    worlds = list(map(world_of, replicas))
    lanes = len(np.unique(worlds[0]))

    def means(number: str, episodes: int) -> list[Float64]:
        return [
            mean_of_worlds(rows[number].to_numpy(), world, episodes)
            for rows, world in zip(replicas, worlds, strict=True)
        ]

    peak_curves = means(gain_metric(table), PEAK_EPISODES)
    end_curves = means(gain_metric(table), LAST_EPISODES)
    length = min(map(len, peak_curves))
    peak_curve = np.mean([curve[:length] for curve in peak_curves], 0)
    end_curve = np.mean([curve[:length] for curve in end_curves], 0)
    size = episodes_per_world(PEAK_EPISODES, lanes) * lanes
    later = episodes_per_world(LAST_EPISODES, lanes) * lanes - size
    peak_index = int(np.nanargmax(peak_curve))
    lives = fmean(curve[-1] for curve in means("steps", LAST_EPISODES))
    return Outcome(
        begins=float(peak_curve[~np.isnan(peak_curve)][0]),
        peak=float(peak_curve[peak_index]),
        around=min(peak_index + 1 - min(size, length) + size // 2, length),
        low=float(np.nanmin(end_curve[min(peak_index + later, length - 1) :])),
        last=fmean(curve[-1] for curve in end_curves),
        lived=lives / pc.max(rows["steps"]).as_py(),
        random=random,
        agents=pc.max(table["agent"]).as_py() + 1,
    )
