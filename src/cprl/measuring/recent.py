"""Recent: the mean of the last values, while they come."""

from collections import deque
from collections.abc import Sequence
from math import ceil, isnan
from statistics import fmean
from typing import Any

from cprl import arguments


class Recent:
    """The mean of the last values: of a share of those so far, but of `least` at least.

    Args:
        least: how many values at least; with fewer, the mean is that of all.
        share: of the values so far, 0..1; 0 for a window of always `least`.

    Raises:
        ValueError: if a number is out of range.
    """

    def __init__(self, least: int, *, share: float = 0.0) -> None:
        self.least = arguments.integer("least", least, 1)
        self.share = arguments.number("share", share, low=0.0, high=1.0, allowed="a number from 0 to 1")
        self.count = 0
        """Values so far."""
        self._last: deque[float] = deque()

    @property
    def window(self) -> int:
        """How many values the mean is of, at most."""
        return max(self.least, ceil(self.share * self.count))

    def add(self, value: float) -> float:
        """Adds a value; returns the mean of the last ones that are defined, NaN if none is."""
        self.count += 1
        self._last.append(float(value))
        while len(self._last) > self.window:
            self._last.popleft()
        defined = [own for own in self._last if not isnan(own)]
        return fmean(defined) if defined else float("nan")

    def state_dict(self) -> dict[str, Any]:
        """The values in the window, and how many came."""
        return {"last": list(self._last), "count": self.count}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continues from a state that `state_dict` returned."""
        last: Sequence[float] = state["last"]
        self._last, self.count = deque(last), int(state["count"])
