"""Clocks: the seconds of a training by what they are spent on, its speed, and time spent compiling."""

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from math import nan
from typing import Any, Final

from cprl.system.working import working

RULES: Final = "the rules (10 to 20 s, once)"


class CompileClock:
    """Counts the seconds in which the rules (Numba) and updates (torch) are compiled.

    Compilations run in the training's thread; other threads may read the clock.
    """

    def __init__(self) -> None:
        self._spent_s = 0.0
        self._began: float | None = None

    @contextmanager
    def running(self, what: str = RULES) -> Iterator[None]:
        """Count the time that the block takes, and say so; a block within a block counts once.

        Args:
            what: what is compiled.
        """
        if self._began is not None:
            yield
            return
        self._began = time.perf_counter()
        try:
            with working(f"compiling {what}", before_s=self._spent_s):
                yield
        finally:
            self._spent_s = self.total_s
            self._began = None

    @property
    def is_running(self) -> bool:
        return self._began is not None

    @property
    def total_s(self) -> float:
        """Return the seconds of all compilations so far, the one under way included."""
        began = self._began
        return self._spent_s + (0.0 if began is None else time.perf_counter() - began)


CLOCK: Final = CompileClock()


def running_s() -> float:
    """Return the time in seconds by a clock that stands still while code is compiled."""
    return time.perf_counter() - CLOCK.total_s


class Speed:
    """The speed of a count, by a clock that stands still while code is compiled.

    Args:
        count: the count so far, which took no time.
    """

    def __init__(self, count: float = 0) -> None:
        self._began = self._then = running_s()
        self._before = self._last = count

    @property
    def waited_s(self) -> float:
        """Return the seconds since the last `lap`."""
        return running_s() - self._then

    def lap(self, count: float) -> float:
        """Return the count per second since the last lap, given the count now; NaN if no time has passed."""
        waited_s = self.waited_s
        since_then = count - self._last
        self._then += waited_s
        self._last = count
        return since_then / waited_s if waited_s > 0 else nan

    def mean(self, count: float) -> float | None:
        """Return the count per second since the beginning; None if nothing was counted."""
        spent_s = running_s() - self._began
        counted = count - self._before
        return counted / spent_s if counted > 0 and spent_s > 0 else None


class Times:
    """The times of a training or a run from now on, with those before it was stopped.

    Attributes:
        busy_s: seconds of acting, storing and updating, compiling included: those of `with times:` blocks.
    """

    def __init__(self) -> None:
        self.load_state_dict({"spent_s": 0.0, "compiling_s": 0.0, "busy_s": 0.0})

    def __enter__(self) -> None:
        self._busy_since = time.perf_counter()

    def __exit__(self, *error: object) -> None:
        self.busy_s += time.perf_counter() - self._busy_since

    @property
    def spent_s(self) -> float:
        """Return all seconds so far."""
        return self._before_s["spent_s"] + time.monotonic() - self._began

    @property
    def compiling_s(self) -> float:
        """Return the seconds in which code was compiled, or read from torch's and Numba's caches."""
        return self._before_s["compiling_s"] + CLOCK.total_s - self._compiled_s

    @property
    def acting_storing_updating_s(self) -> float:
        """Return the seconds of acting, storing and updating alone, the game included."""
        return max(0.0, self.busy_s - self.compiling_s)

    def report(self, training: "Times") -> dict[str, float]:
        """Return the entries of `report.json` for a run and its training."""
        return {
            "training_s": round(training.spent_s, 1),
            "acting_storing_updating_s": round(training.acting_storing_updating_s, 3),
            "compiling_s": round(self.compiling_s + training._before_s["compiling_s"], 3),
            "wall_s": round(self.spent_s + training._before_s["spent_s"], 3),
        }

    def state_dict(self) -> dict[str, float]:
        return {"spent_s": self.spent_s, "compiling_s": self.compiling_s, "busy_s": self.busy_s}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self._began = time.monotonic()
        self._compiled_s = CLOCK.total_s
        self._before_s = {name: float(state[name]) for name in ("spent_s", "compiling_s")}
        self.busy_s = float(state["busy_s"])
