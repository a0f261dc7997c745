"""Times: where the time of a training and of a run goes, in seconds."""

import time
from collections.abc import Mapping
from typing import Any

from cprl.system.compile_clock import CLOCK


class Times:
    """The time that a training takes, what it took before it was stopped included.

    Attributes:
        busy_s: seconds of acting, storing and updating, compiling included.
    """

    def __init__(self) -> None:
        self._began, self._compiled_s = time.monotonic(), CLOCK.total_s
        self._before = {"spent_s": 0.0, "compiling_s": 0.0}
        self.busy_s = 0.0

    @property
    def spent_s(self) -> float:
        """Seconds of everything since the training was made."""
        return self._before["spent_s"] + time.monotonic() - self._began

    @property
    def compiling_s(self) -> float:
        """Seconds in which code was compiled, or read from torch's and Numba's caches."""
        return self._before["compiling_s"] + CLOCK.total_s - self._compiled_s

    @property
    def acting_storing_updating_s(self) -> float:
        """Seconds of acting, storing and updating alone, the game included."""
        return max(0.0, self.busy_s - self.compiling_s)

    def state_dict(self) -> dict[str, float]:
        """What it took so far."""
        return {"spent_s": self.spent_s, "compiling_s": self.compiling_s, "busy_s": self.busy_s}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from a state of `state_dict`."""
        self._began, self._compiled_s = time.monotonic(), CLOCK.total_s
        self._before = {name: float(state[name]) for name in self._before}
        self.busy_s = float(state["busy_s"])


class RunTimes:
    """The time of a whole run: its training, and all that comes before and after."""

    def __init__(self) -> None:
        self._began, self._compiled_s = time.monotonic(), CLOCK.total_s

    def report(self, training: Times) -> dict[str, float]:
        """The entries of `report.json`; of a run that was resumed with what the training took before."""
        wall_s = time.monotonic() - self._began + training._before["spent_s"]
        compiling_s = CLOCK.total_s - self._compiled_s + training._before["compiling_s"]
        return {
            "training_s": round(training.spent_s, 1),
            "acting_storing_updating_s": round(training.acting_storing_updating_s, 3),
            "compiling_s": round(compiling_s, 3),
            "wall_s": round(wall_s, 3),
        }
