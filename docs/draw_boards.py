"""Draws boards as an episode begins: docs/boards/<name>.png.

python docs/draw_boards.py
"""

from pathlib import Path

from matplotlib.image import imsave

from cprl import Game, Rules, maps, presets
from cprl.commons.picture import first_image

FOLDER = Path(__file__).parent / "boards"
SMALL_CELL_PIXELS = 12

BY_RULE = {
    **{
        f"rooms_{entrances}": maps.rooms(entrances) for entrances in ("single", "multiple", "none", "unequal")
    },
    "random_open": maps.random(20, 40, agents=12, density=246 / 800, clustering=0.8, seed=1),
}


def main() -> None:
    """Writes a PNG for each published board, and for some that are made by rule."""
    FOLDER.mkdir(exist_ok=True)
    for name in presets.BOARDS:
        imsave(FOLDER / f"{name}.png", first_image(presets.game(name)))
    for name, board in BY_RULE.items():
        image = first_image(Game(map=board, rules=Rules()), cell_pixels=SMALL_CELL_PIXELS)
        imsave(FOLDER / f"{name}.png", image)
    for path in sorted(FOLDER.glob("*.png")):
        print(path)


if __name__ == "__main__":
    main()
