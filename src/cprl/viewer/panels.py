"""Places in the viewer: several boards in one image, and plots whose horizontal axis is no timeline."""

from math import ceil
from typing import Any, Final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from cprl.commons.decoding import UNSEEN
from cprl.commons.world import Bytes

WINDOWS_APART_PIXELS: Final = 1
WINDOWS_WIDE: Final = 1.7
"""The width of the viewer's area for windows, divided by its height, approximately."""


def window_corners(
    agents: int, window: tuple[int, int], *, wide: float = WINDOWS_WIDE
) -> list[tuple[int, int]]:
    """The top-left corner (row, col) of each agent's window in a mosaic with cells as large as possible."""
    rows, cols = (length + WINDOWS_APART_PIXELS for length in window)

    def cell_size(columns: int) -> float:
        return min(wide / (columns * cols), 1 / (ceil(agents / columns) * rows))

    columns = max(range(1, agents + 1), key=cell_size)
    return [(agent // columns * rows, agent % columns * cols) for agent in range(agents)]


def mosaic_size(agents: int, window: tuple[int, int]) -> tuple[int, int]:
    corners = window_corners(agents, window)
    return max(row for row, _ in corners) + window[0], max(col for _, col in corners) + window[1]


def mosaic(windows: Bytes) -> Bytes:
    """The windows of all agents in a mosaic at `window_corners`, with UNSEEN between them.

    Args:
        windows: uint8 [T, N, X, Y], classes of `classes_seen`.

    Returns:
        uint8 [T, rows, columns], with the size of `mosaic_size`.
    """
    frames, agents, rows, columns = windows.shape
    joined = np.full((frames, *mosaic_size(agents, (rows, columns))), UNSEEN, np.uint8)
    for agent, (top, left) in enumerate(window_corners(agents, (rows, columns))):
        joined[:, top : top + rows, left : left + columns] = windows[:, agent]
    return joined


_WIDE: Final = 3.0
"""The width of half a tab of the viewer, divided by its height, about."""
_LABEL_SHARE: Final = 0.3
"""The height of a line of text, of that of a board: texts have a size of their own on the screen."""

HIGH: Final = 12
"""The height of a panel of bars, in pixels: the largest bar has one less."""
BELOW: Final = 4
"""The room below bars for the names of actions."""
BAR, APART = 5, 1
"""The width of a bar and of the gap, in pixels."""


class Panels:
    """The places of equal boards in one image.

    Args:
        columns: how many stand side by side; by default so many that they are as large as possible.
    """

    def __init__(self, count: int, size: tuple[int, int], *, columns: int | None = None) -> None:
        label = max(2, ceil(_LABEL_SHARE * size[0]))
        padded = size[0] + label, size[1]
        corners = np.array(window_corners(count, padded, wide=_WIDE))
        if columns is not None:
            places = np.arange(count)
            cells = np.stack([places // columns, places % columns], 1)
            corners = cells * (np.array(padded) + 1)
        self.size = size
        self.corners = corners + np.array((label, 0))
        """int [count, 2], the top-left (row, col) of each board."""
        rows, width = (self.corners.max(0) + size).tolist()
        self.shape = rows, width
        """The rows and columns of the image."""
        self._label = label

    def joined(self, boards: NDArray[Any], background: Any) -> NDArray[Any]:
        """One image of all boards: [count, rows, columns, ...] to [*shape, ...]."""
        image = np.empty((*self.shape, *boards.shape[3:]), boards.dtype)
        image[:] = background
        for (top, left), board in zip(self.corners, boards, strict=True):
            image[top : top + self.size[0], left : left + self.size[1]] = board
        return image

    @property
    def bounds(self) -> tuple[tuple[float, float], tuple[float, float]]:
        rows, columns = self.shape
        return (-0.5, columns + 0.5), (-0.5, rows + 0.5)

    def labels(self) -> Any:
        """The points at which texts stand, as Rerun's static part of `Points2D`; their labels vary."""
        tops = self.corners[:, ::-1] + (self.size[1] / 2, 0.1 - self._label)
        return rr.Points2D.from_fields(
            positions=tops.astype(np.float32), radii=[0.0], colors=[(220, 220, 220)], show_labels=True
        )

    def frames(self) -> Any:
        """A frame around each board, as Rerun's static part of `Boxes2D`; colours vary."""
        return rr.Boxes2D.from_fields(
            centers=(self.corners[:, ::-1] + np.array(self.size[::-1]) / 2).astype(np.float32),
            half_sizes=np.tile(np.array(self.size[::-1], np.float32) / 2, (len(self.corners), 1)),
            radii=[0.25],
            show_labels=False,
        )


def decision_panels(agents: int, actions: int, window: tuple[int, int]) -> Panels:
    """The places of the agents' panels, arranged as their windows (X, Y) are."""
    columns = sum(row == 0 for row, _ in window_corners(agents, window))
    return Panels(agents, (HIGH + BELOW, actions * (BAR + APART) + APART), columns=columns)


def row(name: str, *views: Any) -> Any:
    there = [view for view in views if view is not None]
    return rrb.Horizontal(*there, name=name) if there else None


PLOT_WIDE, PLOT_HIGH = 260.0, 80.0
"""The size of the plotting area, in the view's units; (0, 0) is its top left."""
TITLE = PLOT_WIDE / 2, -16.0
"""Where a title hangs."""
BOUNDS: Final = ((-24.0, PLOT_WIDE + 16.0), (TITLE[1], PLOT_HIGH + 26.0))
"""What the view shows, x and y: the area with room for texts."""
_GREY, _FAINT, _TEXT = (120, 120, 120), (50, 52, 58), (200, 200, 200)


class Axes:
    """Two axes from 0 on, with their ticks; the view's name says what the vertical one is."""

    def __init__(self, x: str, *, x_end: float, y_end: float) -> None:
        self.name = x
        self.ends = np.array((x_end, y_end))

    def placed(self, x: Any, y: Any) -> NDArray[np.float32]:
        """Where numbers are in the view: [points, 2]."""
        share = np.stack([np.asarray(x, np.float64), np.asarray(y, np.float64)], -1) / self.ends
        placed: NDArray[np.float32] = (share * (PLOT_WIDE, -PLOT_HIGH) + (0, PLOT_HIGH)).astype(np.float32)
        return placed

    def drawn(self) -> tuple[Any, Any]:
        """The axes with lines at their ticks, and the texts, as Rerun's archetypes."""
        ticks = [_ticks(float(end)) for end in self.ends]
        upright = [self.placed([tick, tick], [0, self.ends[1]]) for tick in ticks[0]]
        level = [self.placed([0, self.ends[0]], [tick, tick]) for tick in ticks[1]]
        count = len(upright) + len(level)
        rim = self.placed([0, 0, self.ends[0]], [self.ends[1], 0, 0])
        below = [(*self.placed(tick, 0)[:1], PLOT_HIGH + 1.0) for tick in ticks[0]]
        left = [(-10.0, self.placed(0, tick)[1] - 6.0) for tick in ticks[1]]
        texts = [*(f"{tick:g}" for of_axis in ticks for tick in of_axis), self.name]
        points = [*below, *left, (PLOT_WIDE / 2, PLOT_HIGH + 13.0)]
        lines = rr.LineStrips2D(
            [*upright, *level, rim], colors=[*[_FAINT] * count, _GREY], radii=[*[0.1] * count, 0.3]
        )
        return lines, rr.Points2D(points, labels=texts, colors=_TEXT, radii=0.0, show_labels=True)


def titled(text: str) -> Any:
    return rr.Points2D([TITLE], labels=[text], radii=0.0, colors=_TEXT, show_labels=True)


def _ticks(end: float) -> list[float]:
    """Four or five round numbers from 0 on."""
    size = 10 ** np.floor(np.log10(end))
    step = next(part * size for part in (0.1, 0.2, 0.25, 0.5, 1.0, 2.0) if end / (part * size) <= 5)
    return [step * index for index in range(int(end / step + 1e-9) + 1)]
