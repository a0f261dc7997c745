"""Axes: a plot whose horizontal axis is no timeline, drawn in a 2D view; Rerun's own plots are over time."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

WIDE, HIGH = 260.0, 80.0
"""The size of the plotting area, in the view's units; (0, 0) is its top left."""
TITLE = WIDE / 2, -16.0
"""Where a title hangs."""
BOUNDS: Final = ((-24.0, WIDE + 16.0), (TITLE[1], HIGH + 26.0))
"""What the view shows, x and y: the area with room for texts."""
_GREY, _FAINT, _TEXT = (120, 120, 120), (50, 52, 58), (200, 200, 200)


class Axes:
    """Two axes from 0 on, with their ticks; the view's name says what the vertical one is.

    Args:
        x: the name and unit of the horizontal axis.
        x_end: the largest number on the horizontal axis.
        y_end: the largest number on the vertical axis.
    """

    def __init__(self, x: str, *, x_end: float, y_end: float) -> None:
        self.name = x
        self.ends = np.array((x_end, y_end))

    def placed(self, x: Any, y: Any) -> NDArray[np.float32]:
        """Where numbers are in the view: [points, 2]."""
        share = np.stack([np.asarray(x, np.float64), np.asarray(y, np.float64)], -1) / self.ends
        placed: NDArray[np.float32] = (share * (WIDE, -HIGH) + (0, HIGH)).astype(np.float32)
        return placed

    def drawn(self) -> tuple[Any, Any]:
        """The axes with lines at their ticks, and the texts, as Rerun's archetypes."""
        import rerun as rr

        ticks = [_ticks(float(end)) for end in self.ends]
        upright = [self.placed([tick, tick], [0, self.ends[1]]) for tick in ticks[0]]
        level = [self.placed([0, self.ends[0]], [tick, tick]) for tick in ticks[1]]
        count = len(upright) + len(level)
        rim = self.placed([0, 0, self.ends[0]], [self.ends[1], 0, 0])
        below = [(*self.placed(tick, 0)[:1], HIGH + 1.0) for tick in ticks[0]]
        left = [(-10.0, self.placed(0, tick)[1] - 6.0) for tick in ticks[1]]
        texts = [*map(_short, ticks[0]), *map(_short, ticks[1]), self.name]
        points = [*below, *left, (WIDE / 2, HIGH + 13.0)]
        lines = rr.LineStrips2D(
            [*upright, *level, rim], colors=[*[_FAINT] * count, _GREY], radii=[*[0.1] * count, 0.3]
        )
        return lines, rr.Points2D(points, labels=texts, colors=_TEXT, radii=0.0, show_labels=True)


def _ticks(end: float) -> list[float]:
    """Four or five round numbers from 0 on."""
    size = 10 ** np.floor(np.log10(end))
    step = next(part * size for part in (0.1, 0.2, 0.25, 0.5, 1.0, 2.0) if end / (part * size) <= 5)
    return [step * index for index in range(int(end / step + 1e-9) + 1)]


def _short(number: float) -> str:
    return f"{number:g}"
