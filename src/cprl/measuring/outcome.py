"""How a training goes, and how it went: one set of words, windows and thresholds for all who say it.

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

from cprl.measuring.registry import COLLECTIVE_RETURN, INCOME
from cprl.measuring.table import where, world_of
from cprl.measuring.windows import LAST_EPISODES, mean_of_worlds, rounds_of
from cprl.values.arrays import Float64

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
"""Episodes of the mean whose highest value is the peak of a training; before there are as many nothing is
judged."""
RECENT_SHARE: Final = 0.1
"""The share of the episodes so far whose mean is judged while a training runs."""
LEARNED: Final = 1.5
"""How many times random play the peak of agents who learned something is at least."""
LOST: Final = 1 / 3
"""The part of the peak's lead over random play that is lost in a fall, at least."""
LEAST_LOSS: Final = 0.15
"""The share of the peak that is lost in a fall, however small its lead over random play."""
REGAINED: Final = 1 / 4
"""The part of the loss that is regained in a recovery, at least."""
RISEN: Final = 0.1
"""The share of its level by which a mean exceeds it to be rising."""
BELOW_RANDOM: Final = 0.95
"""How many times random play the end of a tragedy is, at most."""
SHORT: Final = 0.1
"""The share of random play by which a mean falls short of it to be below it while a training runs; of as few
as ten episodes, it has to be more than at the end."""
LIVED: Final = 0.7
"""Of the steps that a board can last, what boards last in a tragedy at most."""
STILL_DEAD: Final = 0.9
"""The share of boards that die until which agents whose boards all died are called dead."""
EXPLORES: Final = 0.5
"""An epsilon above it is exploration even while it does not fall."""


class Course:
    """The live label of a training, episode by episode.

    It is for people who watch. With m the mean over the last 10 % of the episodes of each replica so far (at
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
        replicas: Those of the training. It is judged when all of them have ended W more episodes, each by as
            many as the others.
        worlds: The worlds W of each replica.
    """

    def __init__(self, replicas: int = 1, worlds: int = 1) -> None:
        self.random_play: float | None = None
        """r; None for the first mean instead."""
        self.label = BEGINS
        self.mean = nan
        """m after the last episode."""
        self.peak = nan
        """The highest m; NaN until there are enough episodes."""
        self.explores: bool | None = None
        """Whether the epsilon of a learner falls, or is above 0.5; None while that is not known, and for
        learners without one."""
        self._worlds = worlds
        self._least = rounds_of(PEAK_EPISODES, worlds)
        self._waiting: list[deque[tuple[int, float, bool]]] = [deque() for _ in range(replicas)]
        """Episodes of each replica that the others have not ended."""
        self._recent: dict[tuple[int, int], _Recent] = {}
        """By replica and world."""
        self._rounds = 0
        """How often each replica has ended W episodes."""
        self._course = STEADY
        self._low = self._top = self._first = self._level = nan
        self._highest = 0
        """The round with the highest m."""
        self._epsilons: dict[str, float] = {}

    def add(self, value: float, *, replica: int = 0, world: int = 0, has_died: bool | None = None) -> str:
        """Add an episode that a world has ended, and return the label.

        Args:
            value: What all agents got, e.g. the collective return; one that is not finite is left out.
            has_died: Whether the board died before the clock; None for a game without stock.
        """
        self._waiting[replica].append((world, value, bool(has_died)))
        if all(len(ended) >= self._worlds for ended in self._waiting):
            self._add_round()
        return self.label

    def explore(self, epsilons: Mapping[str, float]) -> bool | None:
        """Judge whether agents explore.

        Args:
            epsilons: Of each learner that has one now, by its name; NaN is left out.
        """
        finite = {name: float(epsilon) for name, epsilon in epsilons.items() if isfinite(epsilon)}
        if any(epsilon > EXPLORES for epsilon in finite.values()):
            self.explores = True
        elif self._epsilons and finite:
            self.explores = any(
                epsilon < self._epsilons.get(name, epsilon) for name, epsilon in finite.items()
            )
        self._epsilons |= finite
        return self.explores

    @property
    def _window(self) -> int:
        """How many episodes of each world m is a mean of."""
        return max(self._least, ceil(RECENT_SHARE * self._rounds))

    def _add_round(self) -> None:
        """Take W episodes of each replica, and judge."""
        self._rounds += 1
        for replica, ended in enumerate(self._waiting):
            for _ in range(self._worlds):
                world, value, has_died = ended.popleft()
                if isfinite(value):
                    of_world = self._recent.setdefault((replica, world), _Recent())
                    of_world.add(value, has_died, most=self._window)
        recent = self._recent.values()
        if recent:
            self.mean = fmean(of_world.mean for of_world in recent)
        fewest = min(map(len, recent), default=0)
        if len(recent) == len(self._waiting) * self._worlds and fewest >= self._least:
            self._course = self._followed(self._course)
            self.label = self._judged()

    def _judged(self) -> str:
        random = self.random_play
        is_below = self.label in (BELOW, DEAD)
        if random is None or self.mean >= random - (0 if is_below else SHORT * abs(random)):
            return self._course
        recent = self._recent.values()
        died = sum(of_world.died for of_world in recent) / sum(map(len, recent))
        return DEAD if died >= (STILL_DEAD if self.label == DEAD else 1) else BELOW

    def _followed(self, course: str) -> str:
        """Return the course after a round. `_top` is p, and `_low` the lowest mean of a fall."""
        mean = self.mean
        if isnan(self.peak):
            self.peak = self._top = self._first = self._level = mean
        is_highest = mean >= self.peak
        if is_highest:
            self.peak = mean
            self._highest = self._rounds
        if course == FALLING:
            self._low = min(self._low, mean)
            self._level = self._low
            if not is_regained(mean, peak=self._top, low=self._low):
                return course
            self._top = mean
            course = RECOVERING
        self._top = max(self._top, mean)
        random = self._first if self.random_play is None else self.random_play
        if is_lost(mean, peak=self._top, random=random):
            self._low = mean
            return FALLING
        if course == RECOVERING:
            return RISING if is_highest else course
        if mean - self._level > RISEN * abs(self._level):
            self._level = mean
            return RISING
        is_recent = self._rounds < self._highest + self._window
        return RISING if course == RISING and is_recent else STEADY


class _Recent:
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
    return loss > 0 and loss >= LOST * (peak - random) and loss >= LEAST_LOSS * abs(peak)


def is_regained(mean: float, *, peak: float, low: float) -> bool:
    """Return whether a mean has recovered from the lowest one of a fall."""
    return mean >= low + REGAINED * (peak - low)


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How a training of one replica went, or of several, of which each mean is the mean over replicas."""

    begins: float
    """What all agents got in the first 10 episodes, their mean."""
    peak: float
    """The highest mean of 10 episodes."""
    around: int
    """The episode about which these are, counted from 1."""
    low: float
    """The lowest mean of 30 episodes that begin with those of the peak, or later."""
    last: float
    """The mean of the last 30 episodes."""
    lived: float
    """How long boards lasted in the last 30 episodes, as a share of the longest life in the training."""
    random: float
    """What agents who act at random get, the mean."""
    agents: int

    @property
    def word(self) -> str:
        """How it went.

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
        mere fall, why boards have to die. The numbers are ours. Whether the difference is more than chance is
        another question, which intervals over replicas answer.
        """
        if self.peak < LEARNED * self.random:
            return NO_BETTER
        has_fallen = is_lost(self.low, peak=self.peak, random=self.random)
        if has_fallen and is_regained(self.last, peak=self.peak, low=self.low):
            return RECOVERY
        if self.last <= BELOW_RANDOM * self.random:
            is_ruin = self.agents > 1 and self.lived <= LIVED
            return TRAGEDY if is_ruin else DECLINE
        return DECLINE if is_lost(self.last, peak=self.peak, random=self.random) else HARVESTING


RULE: Final = (
    f"its last {LAST_EPISODES} episodes against its peak and random play ({NO_BETTER}: no mean of "
    f"{PEAK_EPISODES} episodes reached {LEARNED} times random play; {TRAGEDY}: several agents get at "
    f"most {BELOW_RANDOM:.0%} of random play, and boards last at most {LIVED:.0%} of the longest life)"
)
"""How the word of an outcome is found, as tables say it."""


def outcome_of(table: pa.Table, *, random: float) -> Outcome:
    """Return how a training went, of one replica or over several.

    Args:
        table: Its episodes, those of each replica in the order in which they ended.
        random: What agents who act at random get, the mean.
    """
    rows = where(table, agent=0)
    got = COLLECTIVE_RETURN if COLLECTIVE_RETURN in table.column_names else INCOME
    replicas = [where(rows, replica=replica) for replica in rows["replica"].unique().to_pylist()]
    worlds = [world_of(of_one) for of_one in replicas]
    lanes = len(np.unique(worlds[0]))

    def means(number: str, episodes: int) -> list[Float64]:
        values = (of_one[number].to_numpy() for of_one in replicas)
        return [mean_of_worlds(*of_one, episodes) for of_one in zip(values, worlds, strict=True)]

    tens = means(got, PEAK_EPISODES)
    thirties = means(got, LAST_EPISODES)
    length = min(map(len, tens))
    short = np.mean([of_one[:length] for of_one in tens], 0)
    long = np.mean([of_one[:length] for of_one in thirties], 0)
    size = rounds_of(PEAK_EPISODES, lanes) * lanes
    later = rounds_of(LAST_EPISODES, lanes) * lanes - size
    at = int(np.nanargmax(short))
    lives = fmean(of_one[-1] for of_one in means("steps", LAST_EPISODES))
    return Outcome(
        begins=float(short[~np.isnan(short)][0]),
        peak=float(short[at]),
        around=min(at + 1 - min(size, length) + size // 2, length),
        low=float(np.nanmin(long[min(at + later, length - 1) :])),
        last=fmean(of_one[-1] for of_one in thirties),
        lived=lives / pc.max(rows["steps"]).as_py(),
        random=random,
        agents=pc.max(table["agent"]).as_py() + 1,
    )
