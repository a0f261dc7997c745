"""Observations back to classes of cells, whatever form the game gives them."""

from typing import Final

import numpy as np

from cprl.commons.game import Game
from cprl.values.arrays import UInt8

UNSEEN: Final = 255
"""The class of a colour that the game does not use, and of a pixel that lies in no window."""


def classes_seen(game: Game, windows: UInt8) -> UInt8:
    """Return the class of each cell (`cprl.commons.cells`), uint8 [T, N, X, Y], of a game's observations,
    uint8 [T, N, C, X, Y]; UNSEEN for a colour that the game does not use.
    """
    windows = windows[:, :, : len(game.cell_channels)]
    if game.observation.encoding == "one_hot":
        classes: UInt8 = np.take(np.array(game.cell_classes, np.uint8), windows.argmax(2))
        return classes
    packed = windows.astype(np.uint32)
    keys = packed[:, :, 0] | packed[:, :, 1] << 8 | packed[:, :, 2] << 16
    classes = np.full(keys.shape, UNSEEN, np.uint8)
    for kind, (red, green, blue) in enumerate(game.palette.astype(np.uint32)):
        classes[keys == (red | green << 8 | blue << 16)] = kind
    return classes
