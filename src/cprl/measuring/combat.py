"""Combat: whether a training, after a tragedy, earns more again while its agents still tag each other.

The phases of `cprl.measuring.phases` depend on the number of change points and on a threshold of a line's
slope: between the lines that the study draws, its own collective return rises by a hair too little to be
called combat, and with four or five change points the pattern breaks. This measure has neither. It looks at
running means over `LONG` episodes, long enough that a level that only wanders does not pass for a fall and a
recovery, and compares three moments of each replica:

    tragedy   the episode at which collective return, survival and peacefulness together stand furthest below
              the highest that each has had before: the one that has fallen least decides
    fall      by how much that one has fallen by then, as a share of its highest
    rise      by how much the collective return lies higher in the mean of all later episodes, as a share of
              what it had fallen
    peace     the peacefulness of all later episodes over its highest before

A replica shows a tragedy if the fall is at least `FALL`, and combat if it also rises by at least `RISE` and
its peace stays below 1: the agents earn more again, but not because they have stopped tagging."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike, NDArray

from cprl import arguments

Values = NDArray[np.float64]
Bools = NDArray[np.bool_]

METRICS: Final = ("collective_return", "survival_steps", "peacefulness")
"""The metrics that fall in a tragedy."""
LONG: Final = 300
"""The window of the running means in episodes."""
FALL: Final = 0.2
"""The least fall of a tragedy; all three published metrics fall by a third."""
RISE: Final = 0.25
"""The least rise of combat; the published return regains more than half of what it lost."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Combat:
    """Tragedy and combat of each of R replicas; see the module."""

    tragedy_at: Values
    """The first episode of the running mean at the bottom of the tragedy, float64 [R]."""
    fall: Values
    """float64 [R], at most 1."""
    rise: Values
    """float64 [R]; NaN if the training ends with the tragedy, or nothing fell."""
    peace: Values
    """float64 [R]; NaN likewise."""

    @property
    def tragedy(self) -> Bools:
        """The replicas that show a tragedy, bool [R]."""
        return self.fall >= FALL

    @property
    def combat(self) -> Bools:
        """The replicas that show combat, bool [R]."""
        with np.errstate(invalid="ignore"):
            return self.tragedy & (self.rise >= RISE) & (self.peace < 1)


def combat(metrics: Mapping[str, ArrayLike]) -> Combat:
    """Looks for tragedy and combat in each replica.

    Args:
        metrics: float [R, E] by name, one value per episode, not smoothed; at least `METRICS`.

    Raises:
        ValueError: if a metric is missing, has another shape or is not finite, or there are fewer than
            3 `LONG` episodes.
    """
    curves = [_checked(metrics, name) for name in METRICS]
    shapes = [curve.shape for curve in curves]
    if len(set(shapes)) > 1:
        raise ValueError(f"metrics are {dict(zip(METRICS, shapes, strict=True))}; allowed: one shape for all")
    smoothed = [sliding_window_view(curve, LONG, axis=1).mean(-1) for curve in curves]
    highest = [np.maximum.accumulate(curve, axis=1) for curve in smoothed]
    falls = np.stack([_share(top - own, top) for own, top in zip(smoothed, highest, strict=True)])
    together = falls.min(0)
    at = together.argmax(1)
    row = np.arange(len(at))
    later_return, later_peace = (_after(curve, at + LONG) for curve in (curves[0], curves[2]))
    lowest, top = smoothed[0][row, at], highest[0][row, at]
    return Combat(
        tragedy_at=at.astype(np.float64),
        fall=together[row, at],
        rise=_share(later_return - lowest, top - lowest, undefined=np.nan),
        peace=_share(later_peace, highest[2][row, at], undefined=np.nan),
    )


def _checked(metrics: Mapping[str, ArrayLike], name: str) -> Values:
    arguments.object_of("metrics", metrics, Mapping, "a table of metrics, [R, E] each")
    if name not in metrics:
        raise ValueError(f"metrics lack {name!r}; allowed: at least {list(METRICS)}")
    curve = arguments.floats(f"metrics[{name!r}]", metrics[name])
    if curve.ndim != 2 or not len(curve) or curve.shape[1] < 3 * LONG:
        raise ValueError(
            f"metrics[{name!r}] is {list(curve.shape)}; allowed: [R, E], at least {3 * LONG} episodes"
        )
    if not np.isfinite(curve).all():
        raise ValueError(f"metrics[{name!r}] holds NaN or infinity; allowed: finite numbers")
    return curve


def _after(curve: Values, first: NDArray[np.int64]) -> Values:
    """The mean of each replica's episodes from `first` on, [R]; NaN where fewer than `LONG` follow."""
    return np.array(
        [own[at:].mean() if len(own) - at >= LONG else np.nan for own, at in zip(curve, first, strict=True)]
    )


def _share(part: Values, whole: Values, *, undefined: float = 0.0) -> Values:
    shares: Values = np.divide(part, whole, out=np.full(np.shape(part), undefined), where=whole > 0)
    return shares
