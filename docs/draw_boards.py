"""Draws boards as an episode begins: docs/boards/<name>.png.

python docs/draw_boards.py
"""

from pathlib import Path

import numpy as np
from matplotlib.image import imsave

from cprl import CommonsEnv, Game, Rules, maps, presets

FOLDER = Path(__file__).parent / "boards"
SMALL_CELL_PIXELS = 12

BY_RULE = {
    **{
        f"rooms_{entrances}": maps.rooms(entrances) for entrances in ("single", "multiple", "none", "unequal")
    },
    "random_open": maps.random(20, 40, agents=12, density=246 / 800, clustering=0.8, seed=1),
}


def first_image(game: Game, cell_pixels: int = 24) -> np.ndarray:
    """The board at the start of an episode."""
    env = CommonsEnv(game, seed=0)
    env.reset()
    return env.render(world=0, cell_pixels=cell_pixels)


def main() -> None:
    """Writes a PNG for each published board, and for some that are made by rule."""
    FOLDER.mkdir(exist_ok=True)
    for name in presets.BOARDS:
        imsave(FOLDER / f"{name}.png", first_image(presets.game(name)))
    for name, board in BY_RULE.items():
        imsave(FOLDER / f"{name}.png", first_image(Game(map=board, rules=Rules()), SMALL_CELL_PIXELS))
    for name in presets.names():
        if name not in presets.BOARDS and not name.startswith("perolat/"):  # which are among those by rule
            image = first_image(presets.game(name), SMALL_CELL_PIXELS)
            imsave(FOLDER / f"{name.replace('/', '_')}.png", image)
    for path in sorted(FOLDER.glob("*.png")):
        print(path)


if __name__ == "__main__":
    main()
