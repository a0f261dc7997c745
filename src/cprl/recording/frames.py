"""Frames of one world, collected step by step in memory and handed on as columns."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cprl.commons.colours import APPLE, BEAM, GROUND, MARK, WALL
from cprl.commons.seeing import UNSEEN, classes_seen
from cprl.commons.world import Bools, Bytes, Ints

__all__ = ["UNSEEN", "Frame", "FrameBuffer", "board_with_rim", "classes_seen", "mosaic"]

RIM_CELLS: Final = 1
"""Cells of wall that are shown around the board."""

_SEPARATOR_PIXELS: Final = 1


@dataclass(frozen=True, kw_only=True)
class Frame:
    """One world after one step."""

    board: Bytes
    """uint8 [H, W], classes of `cprl.commons.colours`."""
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


class FrameBuffer:
    """Room for so many frames, allocated once: `add` copies, `take` hands out what there is.

    Args:
        capacity: frames it holds at most.
        board: (H, W).
        windows: (N, C, X, Y).
    """

    def __init__(self, capacity: int, *, board: tuple[int, int], windows: tuple[int, int, int, int]) -> None:
        agents = windows[0]
        self.capacity, self.size = capacity, 0
        self._arrays: dict[str, NDArray[Any]] = {
            "step": np.zeros(capacity, np.int64),
            "episode": np.zeros(capacity, np.int64),
            "board": np.zeros((capacity, *board), np.uint8),
            "windows": np.zeros((capacity, *windows), np.uint8),
            "row": np.zeros((capacity, agents), np.int32),
            "col": np.zeros((capacity, agents), np.int32),
            "heading": np.zeros((capacity, agents), np.int32),
            "in_play": np.zeros((capacity, agents), np.bool_),
        }

    @property
    def is_full(self) -> bool:
        """Whether there is no room for another frame."""
        return self.size == self.capacity

    def add(self, step: int, episode: int, frame: Frame) -> None:
        """Copies a frame; `step` counts environment steps of the whole run."""
        if self.is_full:
            raise ValueError(f"the buffer holds {self.capacity} frames; take them before adding another")
        arrays, at = self._arrays, self.size
        arrays["step"][at], arrays["episode"][at] = step, episode
        for name in ("board", "windows", "row", "col", "heading", "in_play"):
            arrays[name][at] = getattr(frame, name)
        self.size += 1

    def take(self) -> dict[str, NDArray[Any]]:
        """Copies of all frames as columns, [T, ...] each; the buffer is empty afterwards."""
        taken = {name: array[: self.size].copy() for name, array in self._arrays.items()}
        self.size = 0
        return taken


def board_with_rim(boards: Bytes) -> Bytes:
    """Boards with a rim of wall, and without the agents, which are drawn in colours of their own.

    Args:
        boards: uint8 [T, H, W], colour classes.

    Returns:
        uint8 [T, H + 2, W + 2].
    """
    rimmed = np.pad(boards, ((0, 0), (RIM_CELLS,) * 2, (RIM_CELLS,) * 2), constant_values=WALL)
    return np.where(np.isin(rimmed, (GROUND, WALL, APPLE, MARK, BEAM)), rimmed, GROUND).astype(np.uint8)


def mosaic(windows: Bytes) -> Bytes:
    """All agents' windows side by side, a column of UNSEEN between two.

    Args:
        windows: uint8 [T, N, X, Y], classes as `classes_seen` gives them.

    Returns:
        uint8 [T, X, N * Y + N - 1].
    """
    frames, agents, rows, columns = windows.shape
    wide = columns + _SEPARATOR_PIXELS
    joined = np.full((frames, rows, agents * wide - _SEPARATOR_PIXELS), UNSEEN, np.uint8)
    for agent in range(agents):
        joined[:, :, agent * wide : agent * wide + columns] = windows[:, agent]
    return joined
