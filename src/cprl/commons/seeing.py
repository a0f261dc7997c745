"""What a window shows: observations back to classes of cells, whatever form the game gives them."""

from typing import Final

import numpy as np

from cprl.commons.game import Game
from cprl.commons.observation import classes_shown
from cprl.commons.world import Bytes

UNSEEN: Final = 255
"""The class of a colour that is none of the game's, and of a pixel that lies in no window."""


def classes_seen(game: Game, windows: Bytes) -> Bytes:
    """The class of each cell that agents observe, UNSEEN where it is none of the game's.

    Args:
        game: which says what form the observations have.
        windows: uint8 [T, N, C, X, Y], as observed.

    Returns:
        uint8 [T, N, X, Y].
    """
    if game.observation.encoding == "one_hot":
        shown = classes_shown(game.observation, agents=game.agents, hides=game.rules.walls_block_sight)
        classes: Bytes = np.take(np.array(shown, np.uint8), windows.argmax(2))
        return classes
    packed = windows.astype(np.uint32)
    keys = packed[:, :, 0] | packed[:, :, 1] << 8 | packed[:, :, 2] << 16
    classes = np.full(keys.shape, UNSEEN, np.uint8)
    for kind, (red, green, blue) in enumerate(game.palette.astype(np.uint32)):
        classes[keys == (red | green << 8 | blue << 16)] = kind
    return classes
