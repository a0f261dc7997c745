"""What happens in a training, told as it goes on: new bests, and in which phase the society is."""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cprl.measuring import phases
from cprl.runs.curves import running_mean

LOOKS_EVERY: Final = 100
"""Episodes from one look at the phase to the next."""
BEST_OVER: Final = 50
"""Episodes over which a best mean return is told."""
BETTER: Final = 1.05
"""A new best is told when it is so many times the last one told."""
ANOTHER: Final = "another"
"""A phase whose pattern is none of the study's."""


class EventDetector:
    """Keeps the means over replicas of the metrics that phases are told by, episode by episode."""

    def __init__(self) -> None:
        self._means: list[list[float]] = []
        self._best = 0.0
        self.phase: str | None = None

    def add(self, means: Mapping[str, float]) -> list[str]:
        """Takes the means of an episode, and says what is new: events in words."""
        self._means.append([means[name] for name in phases.METRICS])
        told, episode = [], len(self._means)
        if episode % BEST_OVER == 0:
            reached = float(np.mean([own[0] for own in self._means[-BEST_OVER:]]))
            if reached > BETTER * self._best:
                self._best = reached
                told.append(f"new best: {reached:.1f} apples an episode, mean of the last {BEST_OVER}")
        if episode % LOOKS_EVERY == 0:
            found = self.phases()
            if found and (found[-1].label or ANOTHER) != self.phase:
                self.phase = found[-1].label or ANOTHER
                told.append(f"phase: {self.phase}, since about episode {found[-1].first:.0f}")
        return told

    def phases(self) -> list[phases.Phase]:
        """The phases so far, four at most; none before there are enough episodes for one."""
        if len(self._means) < phases.SHORTEST:
            return []
        smoothed = self._smoothed()
        number = max(0, min(3, smoothed.shape[1] // phases.SHORTEST - 1))
        episodes = np.arange(smoothed.shape[1])
        metrics = dict(zip(phases.METRICS, smoothed, strict=True))
        return phases.told_apart(episodes, metrics, number=number)[1]

    def _smoothed(self) -> NDArray[np.float64]:
        """Running means [M, E]; an undefined metric keeps its last value."""
        smoothed = running_mean(np.array(self._means).reshape(-1, len(phases.METRICS)).T)
        for row in smoothed:
            defined = np.flatnonzero(~np.isnan(row))
            row[:] = np.interp(np.arange(len(row)), defined, row[defined]) if len(defined) else 0.0
        return smoothed

    def state_dict(self) -> dict[str, Any]:
        """Everything told so far."""
        return {"means": [list(own) for own in self._means], "best": self._best, "phase": self.phase}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes on from there."""
        self._means = [list(own) for own in state["means"]]
        self._best, self.phase = float(state["best"]), state["phase"]
