"""Detects new best returns of a training while it runs, and its phases once it has ended."""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cprl.measuring import phases
from cprl.runs.curves import running_mean

FEWEST_FOR_PHASES: Final = 1000
"""Episodes of a run whose phases are found when it ends."""
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
        """The collective return of each episode so far."""
        return [own[0] for own in self._means]

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
        return phases.find_phases(episodes, metrics, number=number)[1]

    def _smoothed(self) -> NDArray[np.float64]:
        """Running means [M, E]; an undefined metric repeats its last value."""
        smoothed = running_mean(np.array(self._means).reshape(-1, len(phases.METRICS)).T)
        for row in smoothed:
            defined = np.flatnonzero(~np.isnan(row))
            row[:] = np.interp(np.arange(len(row)), defined, row[defined]) if len(defined) else 0.0
        return smoothed

    def state_dict(self) -> dict[str, Any]:
        """The means and the best so far."""
        return {"means": [list(own) for own in self._means], "best": self._best}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from a state that `state_dict` returned."""
        self._means = [list(own) for own in state["means"]]
        self._best = float(state["best"])
