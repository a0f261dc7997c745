"""Draws the published boards as an episode begins: docs/boards/<name>.png.

python docs/draw_boards.py
"""

from pathlib import Path

from matplotlib.image import imsave

from cprl import presets
from cprl.commons.picture import first_image

FOLDER = Path(__file__).parent / "boards"


def main() -> None:
    """Writes a PNG for each board."""
    FOLDER.mkdir(exist_ok=True)
    for name in presets.BOARDS:
        path = FOLDER / f"{name}.png"
        imsave(path, first_image(presets.game(name)))
        print(path)


if __name__ == "__main__":
    main()
