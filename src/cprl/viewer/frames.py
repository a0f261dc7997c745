"""Frames of one world, collected in memory step by step and returned as columns."""

from dataclasses import dataclass, fields
from math import ceil
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cprl.commons.decoding import UNSEEN
from cprl.commons.world import Bools, Bytes, Ints

WINDOWS_APART_PIXELS: Final = 1
WINDOWS_WIDE: Final = 1.7
"""The width of the viewer's area for windows, divided by its height, approximately."""


@dataclass(frozen=True, kw_only=True)
class Frame:
    """One world after one step."""

    beams: Bools
    """bool [H, W], the cells that a beam covers."""
    stock: Bytes
    """uint8 [K], 1 for a site with an apple."""
    windows: Bytes
    """uint8 [N, C, X, Y], what each agent observes."""
    row: Ints
    """int32 [N]."""
    col: Ints
    """int32 [N]."""
    heading: Ints
    """int32 [N], 0 up, 1 right, 2 down, 3 left."""
    in_play: Bools
    """bool [N]."""
    tagged_by: Ints
    """int32 [N], the agent that tagged this one last; -1 if unknown."""
    harvested: Ints
    """int32 [N], apples harvested in this episode."""


class FrameBuffer:
    """A buffer of frames, allocated once: `add` copies a frame, `take` returns all frames.

    Args:
        capacity: the largest number of frames.
        board: (H, W).
        sites: the number of sites K.
        windows: (N, C, X, Y).
    """

    def __init__(
        self, capacity: int, *, board: tuple[int, int], sites: int, windows: tuple[int, int, int, int]
    ) -> None:
        agents = windows[0]
        self.capacity, self.size = capacity, 0
        self._arrays: dict[str, NDArray[Any]] = {
            "step": np.zeros(capacity, np.int64),
            "episode": np.zeros(capacity, np.int64),
            "beams": np.zeros((capacity, *board), np.bool_),
            "stock": np.zeros((capacity, sites), np.uint8),
            "windows": np.zeros((capacity, *windows), np.uint8),
            "in_play": np.zeros((capacity, agents), np.bool_),
            **{
                name: np.zeros((capacity, agents), np.int32)
                for name in ("row", "col", "heading", "tagged_by", "harvested")
            },
        }

    @property
    def is_full(self) -> bool:
        """Whether the buffer is full."""
        return self.size == self.capacity

    def add(self, step: int, episode: int, frame: Frame) -> None:
        """Copies a frame; `step` counts environment steps of the whole run."""
        if self.is_full:
            raise ValueError(f"the buffer already has {self.capacity} frames; call take() before add()")
        arrays, at = self._arrays, self.size
        arrays["step"][at], arrays["episode"][at] = step, episode
        for field in fields(Frame):
            arrays[field.name][at] = getattr(frame, field.name)
        self.size += 1

    def take(self) -> dict[str, NDArray[Any]]:
        """Copies of all frames as columns, [T, ...] each; the buffer is empty afterwards."""
        taken = {name: array[: self.size].copy() for name, array in self._arrays.items()}
        self.size = 0
        return taken


def window_corners(
    agents: int, window: tuple[int, int], *, wide: float = WINDOWS_WIDE
) -> list[tuple[int, int]]:
    """The top-left corner (row, col) of each agent's window in a mosaic with cells as large as possible.

    Args:
        agents: the number of agents N.
        window: (X, Y).
        wide: the width of the viewer's area, divided by its height.
    """
    rows, cols = (length + WINDOWS_APART_PIXELS for length in window)

    def cell_size(columns: int) -> float:
        return min(wide / (columns * cols), 1 / (ceil(agents / columns) * rows))

    columns = max(range(1, agents + 1), key=cell_size)
    return [(agent // columns * rows, agent % columns * cols) for agent in range(agents)]


def mosaic_size(agents: int, window: tuple[int, int]) -> tuple[int, int]:
    """The rows and columns of the mosaic, in pixels."""
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
