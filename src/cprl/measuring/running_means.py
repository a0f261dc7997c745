"""The window of a running mean, estimated from the curve alone.

A running mean over w episodes has no power at the frequencies k / w: there whole waves fit into the window
and their mean is zero. Its increments are those of the episodes, w apart, so their spectrum is proportional
to sin(pi f w)**2 if the episodes are white noise about a slow course. The window whose spectrum fits best, by
the likelihood of P. Whittle ("Estimation and information in stationary time series", 1953), is the estimate.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cprl import arguments

Values = NDArray[np.float64]

WINDOWS: Final = tuple(range(15, 251, 5))
"""The candidates, in episodes."""
SLOWEST: Final = 0.002
FASTEST: Final = 0.06
"""The frequencies that are looked at, in waves per episode: slower ones are the course of learning, faster
ones are lost where a figure has a point for every seventh episode."""
NOISE: Final = 0.05
"""The power that is left at a null, as a share of the largest: of reading points off a figure."""
INDEPENDENT: Final = 1 / (1 + 2 * (4 / 9 + 1 / 36))
"""The share of frequencies that count as independent. Under a Hann taper the powers of neighbouring ones are
correlated by (2 / 3)**2, and those of the next but one by (1 / 6)**2."""


@dataclass(frozen=True, kw_only=True)
class WindowEstimate:
    """The window of a running mean, and how clearly it differs from others."""

    window_episodes: int
    """The candidate with the largest likelihood."""
    nats: Mapping[int, float]
    """By how much the logarithm of each candidate's likelihood falls short of the largest, at least 0."""

    @property
    def better_by_nats(self) -> float:
        """The advantage over the next best candidate."""
        return min(
            (lost for window, lost in self.nats.items() if window != self.window_episodes), default=0.0
        )


def estimate_window(
    episodes: ArrayLike, values: ArrayLike, *, windows: Sequence[int] = WINDOWS
) -> WindowEstimate:
    """Estimates the window of a running mean.

    Args:
        episodes: the episode of each point, float [P], ascending; points may be unevenly spaced.
        values: the running mean at each point, float [P]. Where in a window it is drawn does not matter.
        windows: the candidates in episodes, at least 2 each; 15, 20 .. 250 by default.

    Raises:
        ValueError: if the shapes differ, a number is not finite, episodes are not ascending, or they span
            fewer than four of the longest candidates.
    """
    at, curve = _checked(episodes, values)
    candidates = [
        arguments.integer("windows", window, 2) for window in arguments.listed("windows", windows, "integers")
    ]
    if not candidates:
        raise ValueError("windows is empty; allowed: at least one candidate")
    if at[-1] - at[0] < 4 * max(candidates):
        raise ValueError(
            f"episodes are {at[0]:g} to {at[-1]:g}; allowed: at least {4 * max(candidates)}, four of the "
            "longest candidates"
        )
    power, frequency = _spectrum(at, curve)
    costs = {window: _cost(power, frequency, window) for window in candidates}
    best = min(costs, key=lambda window: costs[window])
    return WindowEstimate(
        window_episodes=best, nats={window: cost - costs[best] for window, cost in costs.items()}
    )


def _checked(episodes: ArrayLike, values: ArrayLike) -> tuple[Values, Values]:
    at, curve = arguments.floats("episodes", episodes), arguments.floats("values", values)
    if at.ndim != 1 or at.shape != curve.shape:
        raise ValueError(f"episodes is {list(at.shape)} and values {list(curve.shape)}; allowed: [P] both")
    if len(at) < 2 or not np.isfinite(at).all() or (np.diff(at) < 0).any():
        raise arguments.refusal("episodes", episodes, "at least two, finite and ascending")
    if not np.isfinite(curve).all():
        raise arguments.refusal("values", values, "finite numbers")
    return at, curve


def _spectrum(at: Values, curve: Values) -> tuple[Values, Values]:
    """The power of the curve's increments between episodes, and its frequencies, those looked at."""
    every = np.arange(np.ceil(at[0]), at[-1])
    steps = np.diff(np.interp(every, at, curve))
    power = np.abs(np.fft.rfft(steps * np.hanning(len(steps)))) ** 2
    frequency = np.asarray(np.fft.rfftfreq(len(steps)), np.float64)
    seen = (frequency > SLOWEST) & (frequency < FASTEST)
    return power[seen], frequency[seen]


def _cost(power: Values, frequency: Values, window: int) -> float:
    """Minus the logarithm of Whittle's likelihood at the best scale of the spectrum, up to a constant."""
    expected = np.sin(np.pi * frequency * window) ** 2 + NOISE
    with np.errstate(divide="ignore"):
        cost = np.log((power / expected).mean()) + np.log(expected).mean()
    return float(INDEPENDENT * len(power) * cost)
