"""Writes pictures as a GIF or an MP4."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from PIL import Image
from scipy.spatial.distance import cdist

from cprl.runs.files import write_atomically
from cprl.values.array_types import UInt8

HOLD_S: Final = 2.0
"""The seconds for which the last picture is shown."""

_GIF_COLOURS: Final = 127
"""The number of colours in a GIF. With one more for unchanged pixels, a pixel takes at most seven bits."""
_RGB_COLOURS: Final = 2**24
"""The number of colours that a picture can have."""
_RGB_SHIFTS: Final = np.array([16, 8, 0], np.int32)
"""The lowest bits of red, green and blue in the number of a colour, 0 to 2**24 - 1."""


class _Palette:
    """The colours of a GIF, and for each colour of a picture the nearest of them.

    Pillow's own quantize treats colours as equal that differ by up to 4.

    Args:
        samples: pictures whose most frequent colours are the palette.
    """

    def __init__(self, samples: Sequence[UInt8]) -> None:
        counts: Any = Image.fromarray(np.concatenate(samples)).getcolors(_RGB_COLOURS)
        self._colours = np.array([colour for _, colour in sorted(counts, reverse=True)[:_GIF_COLOURS]])
        self._nearest = np.full(_RGB_COLOURS, -1, np.int16)
        """The index of the nearest colour, by the number of a colour; -1 where it is not yet known."""
        self.transparent = len(self._colours)
        """The index of a further entry, for unchanged pixels."""
        self.rgb = self._colours.astype(np.uint8).tobytes() + bytes(3)
        """All entries, three bytes each."""

    def indexed(self, picture: UInt8) -> Image.Image:
        """Return a picture in the colours of the palette."""
        numbers = picture @ (1 << _RGB_SHIFTS)
        unknown = np.unique(numbers[self._nearest[numbers] < 0])
        rgb = unknown[:, np.newaxis] >> _RGB_SHIFTS & 255
        self._nearest[unknown] = cdist(rgb, self._colours).argmin(1)
        image = Image.fromarray(self._nearest[numbers].astype(np.uint8), "P")
        image.putpalette(self.rgb)
        return image


def write_gif(path: Path, pictures: Iterable[UInt8], samples: Sequence[UInt8], *, fps: float) -> None:
    """Write a GIF that repeats, with one palette for all pictures.

    Args:
        path: the file, which is written completely or not at all.
        pictures: one or more pictures, uint8 [height, width, 3] each, RGB.
        samples: some of the pictures, whose most frequent colours are the palette; any other colour becomes
            the nearest of these.
        fps: the pictures per second, rounded so that a picture lasts whole hundredths of a second.
    """
    palette = _Palette(samples)
    first, *others = map(palette.indexed, pictures)
    options = {
        "append_images": others,
        "duration": [10 * max(2, round(100 / fps))] * len(others) + [round(1000 * HOLD_S)],
        "palette": palette.rgb,
        "transparency": palette.transparent,
    }
    write_atomically(
        path, lambda file: first.save(file, format="GIF", save_all=True, loop=0, optimize=True, **options)
    )


def check_can_write_mp4(path: Path) -> None:
    """Raise a ModuleNotFoundError with the command to install imageio-ffmpeg if it is not installed."""
    if find_spec("imageio_ffmpeg") is None:
        raise ModuleNotFoundError(
            f"{path}: an .mp4 needs imageio-ffmpeg, which is not installed; "
            'run pip install "cprl[film]", or name a .gif'
        )


def write_mp4(path: Path, pictures: Iterator[UInt8], *, fps: float) -> None:
    """Write an MP4, whose last picture is shown for `HOLD_S` seconds.

    Args:
        path: the file, which is written completely or not at all.
        pictures: one or more pictures, uint8 [height, width, 3] each, RGB, with even height and width.
        fps: the pictures per second.
    """
    from imageio_ffmpeg import write_frames

    look: Any = {"codec": "libx264", "quality": 8, "macro_block_size": 2, "ffmpeg_log_level": "error"}
    first = next(pictures)
    height, width, _ = first.shape
    with TemporaryDirectory() as folder:
        partial = Path(folder) / "film.mp4"
        with closing(write_frames(partial, (width, height), fps=fps, **look)) as video:
            video.send(None)
            for picture in chain([first], pictures):
                video.send(np.ascontiguousarray(picture))
            for _ in range(round(HOLD_S * fps) - 1):
                video.send(np.ascontiguousarray(picture))
        write_atomically(path, lambda file: file.write(partial.read_bytes()))
