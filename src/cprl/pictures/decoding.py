"""Decode observations, in all forms that games have, into classes of cells."""

from typing import Final

import numpy as np

from cprl.commons.cells import (
    APPLE,
    BEAM,
    CLEANING,
    FIRST_AGENT,
    GROUND,
    MARK,
    OTHER,
    SELF,
    WALL,
    WASTE,
    WATER,
)
from cprl.commons.game import Game
from cprl.institutions.boundaries import AGENT_SIGNS
from cprl.values.array_types import UInt8

UNSEEN: Final = 255
"""The class of an unknown cell: its colour is none of the game, or it lies outside all windows."""
SIGNS: Final = {
    GROUND: ".",
    WALL: "#",
    APPLE: "A",
    BEAM: "*",
    OTHER: "O",
    SELF: "@",
    WATER: "~",
    WASTE: "H",
    CLEANING: "*",
    MARK: "+",
    UNSEEN: "?",
    **{FIRST_AGENT + agent: sign for agent, sign in enumerate(AGENT_SIGNS)},
}
"""The sign of each class of cells in a window as text. Other agents are `O`; those that can be told apart are
0 to 9, a to z, and `O` beyond."""


def classes_seen(game: Game, windows: UInt8) -> UInt8:
    """Return the classes of the cells that agents observed, see `cprl.commons.cells`.

    Args:
        game: the game that the agents play.
        windows: observations of T turns, uint8 [T, N, C, X, Y].

    Returns:
        uint8 [T, N, X, Y]; UNSEEN for colours that the game does not use.
    """
    windows = windows[:, :, : len(game.cell_channels)]
    if game.observation.encoding == "one_hot":
        classes: UInt8 = np.take(np.array(game.cell_classes, np.uint8), windows.argmax(2))
        return classes
    # A colour as one number can be compared at once with the colour of each class.
    channels = windows.astype(np.uint32)
    colours = channels[:, :, 0] | channels[:, :, 1] << 8 | channels[:, :, 2] << 16
    classes = np.full(colours.shape, UNSEEN, np.uint8)
    for cell_class, (red, green, blue) in enumerate(game.palette.astype(np.uint32)):
        classes[colours == (red | green << 8 | blue << 16)] = cell_class
    return classes


def window_text(game: Game, window: UInt8) -> str:
    """Return what an agent observed, uint8 [C, X, Y], as lines of `SIGNS`."""
    classes = classes_seen(game, window[None, None])[0, 0]
    signs = np.vectorize(lambda kind: SIGNS.get(kind, "O"))(classes)
    return "\n".join(map("".join, signs))
