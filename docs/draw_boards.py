"""Boards as an episode begins, drawn for docs/boards/NAME.png by `python docs/draw_figures.py boards`."""

from pathlib import Path

import numpy as np
from matplotlib.image import imsave

from cprl import CommonsEnv, Game, Rules, maps, presets
from cprl.terminal.picture_files import FIGURE_STYLE

FOLDER = Path(__file__).parent / "boards"
SMALL_CELL_PIXELS = 12

BY_RULE = {
    **{
        f"rooms_{entrances}": maps.rooms(entrances) for entrances in ("single", "multiple", "none", "unequal")
    },
    "random_open": maps.random(20, 40, agents=12, density=246 / 800, clustering=0.8, seed=1),
}


def first_image(game: Game, cell_pixels: int = 24) -> np.ndarray:
    """Return the board at the start of an episode."""
    env = CommonsEnv(game, seed=0)
    env.reset()
    return env.render(world=0, cell_pixels=cell_pixels)


def save_image(name: str, image: np.ndarray) -> None:
    """Write a picture of a board."""
    imsave(FOLDER / f"{name}.png", image, metadata={"Software": FIGURE_STYLE})


def draw_boards() -> None:
    """Write a PNG for each published board, and for some that are made by rule."""
    FOLDER.mkdir(exist_ok=True)
    for name in presets.BOARDS:
        save_image(name, first_image(presets.game(name)))
    for name, board in BY_RULE.items():
        save_image(name, first_image(Game(map=board, rules=Rules()), SMALL_CELL_PIXELS))
    for name in presets.names():
        if name not in presets.BOARDS and not name.startswith("perolat/"):  # which are among those by rule
            image = first_image(presets.game(name), SMALL_CELL_PIXELS)
            save_image(name.replace("/", "_"), image)
