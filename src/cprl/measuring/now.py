"""Now: what a group of learners is doing at the moment, judged by its past alone.

The label is for people who watch. It is no phase: phases are found by `cprl.measuring.phases` once the whole
course of a training is known.
"""

from collections.abc import Mapping
from copy import copy
from math import isfinite
from typing import Any, Final

from cprl.measuring.series import Recent

BEGINS: Final = "begins"
EXPLORING: Final = "exploring"
HARVESTING: Final = "harvesting"
TRAGEDY: Final = "tragedy"
RECOVERY: Final = "recovery"
DECLINE: Final = "decline"

FEWEST: Final = 10
"""Episodes of the running mean at least; before there are as many nothing is judged."""
SHARE: Final = 0.1
"""The share of the episodes so far whose mean is judged."""
EXPLORES: Final = 0.5
"""An epsilon above it is exploration even while it does not fall."""
LOST: Final = 1 / 3
"""The part of the peak's lead over random play that must be lost for a tragedy."""
LEAST_LOSS: Final = 0.15
"""The share of the peak that must be lost for a tragedy, however small its lead over random play."""
REGAINED: Final = 1 / 4
"""The part of the loss that must be regained for a recovery."""


class Now:
    """The live label of a training, episode by episode.

    With m the running mean over the last 10 % of the episodes so far (at least 10), p its peak since the last
    tragedy, low its lowest in a tragedy, and r the mean of random play:

    - exploring: while the epsilon of a learner falls, or is above 0.5;
    - tragedy: from p - m >= (p - r) / 3 and p - m >= 0.15 p on;
    - recovery: after a tragedy, from m >= low + (p - low) / 4 on, until the next, or until m passes the
      highest peak;
    - harvesting: else;
    - begins: before there are 10 episodes, for learners without an epsilon.

    What m does while they explore counts: a loss that begins then is a tragedy as soon as they do not.
    A single agent shares nothing: its loss is called decline. Learners without an epsilon (PPO, SAC) are
    never exploring: their running mean is judged from the tenth episode on.

    Args:
        random_play: r, in the unit of the values; None for the first running mean instead.
    """

    def __init__(self, *, agents: int, random_play: float | None = None) -> None:
        self._loss = TRAGEDY if agents > 1 else DECLINE
        self.random_play = random_play
        self.label = BEGINS
        self.mean = float("nan")
        """m after the last episode."""
        self.peak: float | None = None
        """The highest m; None until there are enough episodes."""
        self.explored: int | None = None
        """The number of episodes after which exploration ended; None while it lasts, and if there is none."""
        self._course = HARVESTING
        self._low = self._top = self._first = float("nan")
        self._recent = Recent(FEWEST, share=SHARE)
        self._epsilons: dict[str, float] = {}

    @property
    def window(self) -> int:
        """How many episodes the running mean is of, at most."""
        return self._recent.window

    def add(self, value: float, epsilons: Mapping[str, float] | None = None) -> str:
        """Adds an episode, and returns the label.

        Args:
            value: of the episode, e.g. the collective return as a mean over replicas; finite.
            epsilons: of each learner that has one at the end of the episode, by its name; NaN is left out.
        """
        self.mean = self._recent.add(value)
        if self._recent.count >= FEWEST:
            self._course = self._followed(self._course)
        explores = self._explores(epsilons or {})
        if self.label == EXPLORING and not explores:
            self.explored = self._recent.count
        judged = BEGINS if self.peak is None else self._course
        self.label = EXPLORING if explores else judged
        return self.label

    def _followed(self, course: str) -> str:
        """The course after the episode. `_top` is p, and `_low` the lowest mean of a tragedy."""
        mean = self.mean
        if self.peak is None:
            self.peak = self._top = self._first = mean
        is_highest = mean >= self.peak
        self.peak = max(self.peak, mean)
        if course == self._loss:
            self._low = min(self._low, mean)
            if mean < self._low + REGAINED * (self._top - self._low):
                return course
            self._top, course = mean, RECOVERY
        self._top = max(self._top, mean)
        if self._is_lost(self._top - mean):
            self._low = mean
            return self._loss
        return HARVESTING if is_highest else course

    def _is_lost(self, loss: float) -> bool:
        lead = self._top - (self._first if self.random_play is None else self.random_play)
        return loss > 0 and loss >= LOST * lead and loss >= LEAST_LOSS * abs(self._top)

    def _explores(self, epsilons: Mapping[str, float]) -> bool:
        came = {name: float(epsilon) for name, epsilon in epsilons.items() if isfinite(epsilon)}
        falls = any(epsilon < self._epsilons.get(name, epsilon) for name, epsilon in came.items())
        self._epsilons |= came
        return falls or any(epsilon > EXPLORES for epsilon in came.values())

    def state_dict(self) -> dict[str, Any]:
        """All that came so far; not `random_play`, which is an argument."""
        state = {name: copy(getattr(self, field)) for name, field in _STATE.items()}
        return {**state, "recent": self._recent.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        for name, field in _STATE.items():
            setattr(self, field, copy(state[name]))
        self._recent.load_state_dict(state["recent"])


_STATE: Final = {name: name for name in ("label", "mean", "peak", "explored")} | {
    name: f"_{name}" for name in ("course", "top", "low", "first", "epsilons")
}
"""Where each entry of a state is kept."""
