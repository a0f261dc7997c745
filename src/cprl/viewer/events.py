"""Detects events of a training while it runs: new best returns, and new phases of the society."""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cprl.measuring import phases
from cprl.runs.curves import running_mean

LOOKS_EVERY: Final = 100
"""Episodes between checks of the phase."""
BEST_OVER: Final = 50
"""Episodes of the mean return that is compared with the best."""
BETTER: Final = 1.05
"""The factor by which a new best must exceed the last reported one."""
ANOTHER: Final = "another"
"""The name of a phase that matches no pattern of the study."""


class EventDetector:
    """Detects events from the metrics of each episode, as means over replicas."""

    def __init__(self) -> None:
        self._means: list[list[float]] = []
        self._best = 0.0
        self.phase: str | None = None

    def add(self, means: Mapping[str, float]) -> list[str]:
        """Adds the means of an episode; returns new events as text."""
        self._means.append([means[name] for name in phases.METRICS])
        events, episode = [], len(self._means)
        if episode % BEST_OVER == 0:
            reached = float(np.mean([own[0] for own in self._means[-BEST_OVER:]]))
            if reached > BETTER * self._best:
                self._best = reached
                events.append(f"new best: {reached:.1f} apples per episode, mean of the last {BEST_OVER}")
        if episode % LOOKS_EVERY == 0:
            found = self.phases()
            if found and (found[-1].label or ANOTHER) != self.phase:
                self.phase = found[-1].label or ANOTHER
                events.append(f"phase: {self.phase}, since about episode {found[-1].first:.0f}")
        return events

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
        """The means and events so far."""
        return {"means": [list(own) for own in self._means], "best": self._best, "phase": self.phase}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from a state that `state_dict` returned."""
        self._means = [list(own) for own in state["means"]]
        self._best, self.phase = float(state["best"]), state["phase"]
