"""Panels: several boards side by side in one image, each with a line of text above it."""

from collections.abc import Sequence
from math import ceil
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cprl.viewer.frames import window_corners

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
        count: the number of boards.
        size: the rows and columns of a board, in pixels.
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
        """What a view shows, x and y."""
        rows, columns = self.shape
        return (-0.5, columns + 0.5), (-0.5, rows + 0.5)

    def labels(self) -> Any:
        """The points at which texts stand, as Rerun's static part of `Points2D`; their labels vary."""
        import rerun as rr

        tops = self.corners[:, ::-1] + (self.size[1] / 2, 0.1 - self._label)
        return rr.Points2D.from_fields(
            positions=tops.astype(np.float32), radii=[0.0], colors=[(220, 220, 220)], show_labels=True
        )

    def frames(self, colours: Sequence[tuple[int, int, int]] = ()) -> Any:
        """A frame around each board, as Rerun's static part of `Boxes2D`, without colours where they vary."""
        import rerun as rr

        return rr.Boxes2D.from_fields(
            centers=(self.corners[:, ::-1] + np.array(self.size[::-1]) / 2).astype(np.float32),
            half_sizes=np.tile(np.array(self.size[::-1], np.float32) / 2, (len(self.corners), 1)),
            radii=[0.25],
            colors=list(colours) or None,
            show_labels=False,
        )


def decision_panels(agents: int, actions: int, window: tuple[int, int]) -> Panels:
    """The places of the agents' panels, arranged as their windows (X, Y) are."""
    columns = sum(row == 0 for row, _ in window_corners(agents, window))
    return Panels(agents, (HIGH + BELOW, actions * (BAR + APART) + APART), columns=columns)
