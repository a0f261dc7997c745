"""Now: what a group of learners is doing at the moment, judged by its past alone.

The label is for people who watch. It is no phase: phases are found by `cprl.measuring.phases` once the whole
course of a training is known.
"""

from collections.abc import Mapping
from math import isfinite
from typing import Final

from cprl.measuring.series import Recent

BEGINS: Final = "begins"
RISING: Final = "rising"
STEADY: Final = "steady"
FALLING: Final = "falling"
RECOVERING: Final = "recovering"
BELOW: Final = "below random play"
EXPLORING: Final = "exploring"

FEWEST: Final = 10
"""Episodes of the running mean at least; before there are as many nothing is judged."""
SHARE: Final = 0.1
"""The share of the episodes so far whose mean is judged."""
EXPLORES: Final = 0.5
"""An epsilon above it is exploration even while it does not fall."""
RISEN: Final = 0.1
"""The share of its level by which the mean must exceed it to be rising."""
LOST: Final = 1 / 3
"""The part of the peak's lead over random play that must be lost to be falling."""
LEAST_LOSS: Final = 0.15
"""The share of the peak that must be lost, however small its lead over random play."""
REGAINED: Final = 1 / 4
"""The part of the loss that must be regained to be recovering."""
SHORT: Final = 0.1
"""The share of random play by which the mean must fall short of it to be below it."""


class Now:
    """The live label of a training, episode by episode; of replicas in W worlds, W episodes at a time.

    With m the running mean over the last 10 % of the episodes so far (at least 10), p its peak since the last
    fall, low its lowest in a fall, and r the mean of random play:

    - begins: before there are 10 episodes;
    - below random play: from m < r - 0.1 |r| on, until m >= r;
    - falling: from p - m >= (p - r) / 3 and p - m >= 0.15 p on;
    - recovering: after a fall, from m >= low + (p - low) / 4 on, until the next, or until m passes the
      highest peak;
    - rising: from the episode on in which m is a tenth above its first value, or above the last one of which
      that was true, while m was highest in one of the episodes that it is a mean of;
    - steady: else.

    Args:
        worlds: the worlds W of each replica. A value is then the mean of W episodes, and m is of as few
            values as have these episodes: of sixteen worlds of one value, the mean of sixteen episodes.
    """

    def __init__(self, worlds: int = 1) -> None:
        self.random_play: float | None = None
        """r, in the unit of the values; None for the first running mean instead."""
        self.label = BEGINS
        self.mean = float("nan")
        """m after the last episode."""
        self.peak: float | None = None
        """The highest m; None until there are enough episodes."""
        self.explores: bool | None = None
        """Whether the epsilon of a learner falls, or is above 0.5; None while that is not known, and for
        learners without one."""
        self._course = STEADY
        self._low = self._top = self._first = self._level = float("nan")
        self._highest = 0
        """The number of the value with the highest m."""
        self._recent = Recent(FEWEST, share=SHARE, each=worlds)
        self._epsilons: dict[str, float] = {}

    def add(self, value: float, epsilons: Mapping[str, float] | None = None) -> str:
        """Adds an episode, or W of them, and returns the label.

        Args:
            value: of the episode, e.g. the collective return as a mean over replicas, and over W episodes of
                each; finite.
            epsilons: of each learner that has one at the end of the episode, by its name; NaN is left out.
        """
        self.mean = self._recent.add(value)
        self._look(epsilons or {})
        if self._recent.count >= self._recent.least:
            self._course = self._followed(self._course)
            self.label = BELOW if self._is_below() else self._course
        return self.label

    def _is_below(self) -> bool:
        random = self.random_play
        if random is None:
            return False
        return self.mean < random - (0 if self.label == BELOW else SHORT * abs(random))

    def _followed(self, course: str) -> str:
        """The course after the episode. `_top` is p, and `_low` the lowest mean of a fall."""
        mean = self.mean
        if self.peak is None:
            self.peak = self._top = self._first = self._level = mean
        is_highest = mean >= self.peak
        if is_highest:
            self.peak, self._highest = mean, self._recent.count
        if course == FALLING:
            self._low = min(self._low, mean)
            self._level = self._low
            if mean < self._low + REGAINED * (self._top - self._low):
                return course
            self._top, course = mean, RECOVERING
        self._top = max(self._top, mean)
        if self._is_lost(self._top - mean):
            self._low = mean
            return FALLING
        if course == RECOVERING:
            return RISING if is_highest else course
        if mean - self._level > RISEN * abs(self._level):
            self._level = mean
            return RISING
        is_recent = self._recent.count < self._highest + self._recent.window
        return RISING if course == RISING and is_recent else STEADY

    def _is_lost(self, loss: float) -> bool:
        lead = self._top - (self._first if self.random_play is None else self.random_play)
        return loss > 0 and loss >= LOST * lead and loss >= LEAST_LOSS * abs(self._top)

    def _look(self, epsilons: Mapping[str, float]) -> None:
        """Judges whether learners explore."""
        came = {name: float(epsilon) for name, epsilon in epsilons.items() if isfinite(epsilon)}
        if any(epsilon > EXPLORES for epsilon in came.values()):
            self.explores = True
        elif self._epsilons and came:
            self.explores = any(epsilon < self._epsilons.get(name, epsilon) for name, epsilon in came.items())
        self._epsilons |= came
