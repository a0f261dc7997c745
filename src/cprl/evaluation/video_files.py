"""GIF and MP4 files out of pictures, complete or absent."""

import shutil
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from cprl.commons.world import Bytes
from cprl.runs.files import write_atomically

HOLD_S: Final = 2.0
"""How long the last picture stays."""

_COLOURS: Final = 127
"""Of a GIF, so that a pixel takes at most seven bits; one more marks pixels that do not change."""
_SAMPLES: Final = 24
"""Pictures from which the colours are taken."""


def check_can_write_mp4(path: Path) -> None:
    """Raises a ModuleNotFoundError, saying how to install it, if imageio-ffmpeg is not installed."""
    if find_spec("imageio_ffmpeg") is None:
        raise ModuleNotFoundError(
            f"{path}: an .mp4 needs imageio-ffmpeg, which is not installed; "
            'run pip install "cprl[film]", or name a .gif'
        )


def write_gif(path: Path, pictures: Iterable[Bytes], samples: Sequence[Bytes], *, fps: float) -> None:
    """Writes a GIF that repeats, with one palette for all pictures.

    Args:
        path: the file; an existing file is replaced.
        pictures: uint8 [height, width, 3] each, RGB.
        samples: some of the pictures; their most frequent colours are exact, others become the nearest.
        fps: pictures per second; a GIF counts hundredths of a second, so it is rounded to 100 / n.
    """
    palette = _Palette(samples)
    frames = (palette.image(picture) for picture in pictures)
    duration_ms = 10 * max(2, round(100 / fps))
    first, *others = frames
    durations = [duration_ms] * len(others) + [round(1000 * HOLD_S)]

    def write(file: BinaryIO) -> None:
        first.save(
            file,
            format="GIF",
            save_all=True,
            append_images=others,
            duration=durations,
            loop=0,
            optimize=True,
            palette=palette.bytes,
            transparency=palette.unchanged,
        )

    write_atomically(path, write)


class _Palette:
    """The most frequent colours of some pictures; each other colour becomes the nearest of them."""

    def __init__(self, samples: Sequence[Bytes]) -> None:
        counts: Counter[int] = Counter()
        for picture in samples:
            colours, times = np.unique(_packed(picture), return_counts=True)
            counts.update(dict(zip(colours.tolist(), times.tolist(), strict=True)))
        self._known = np.array([colour for colour, _ in counts.most_common(_COLOURS)], np.int64)
        self._colours = np.stack([self._known >> 16, self._known >> 8 & 255, self._known & 255], -1)
        self._index = np.full(2**24, -1, np.int16)
        self._index[self._known] = np.arange(len(self._known))
        self.unchanged = len(self._known)
        """The index of pixels that do not change."""
        self.bytes = bytes(self._colours.astype(np.uint8).tobytes()) + bytes(3)
        """Red, green and blue of each index."""

    def image(self, picture: Bytes) -> Image.Image:
        """A picture [height, width, 3] in colours of the palette."""
        packed = _packed(picture)
        indices = self._index[packed]
        if (indices < 0).any():
            for colour in np.unique(packed[indices < 0]).tolist():
                self._index[colour] = self._nearest(colour)
            indices = self._index[packed]
        image = Image.fromarray(indices.astype(np.uint8), "P")
        image.putpalette(self.bytes)
        return image

    def _nearest(self, colour: int) -> int:
        apart = self._colours.astype(np.int64) - [colour >> 16, colour >> 8 & 255, colour & 255]
        return int((apart**2).sum(-1).argmin())


def _packed(picture: Bytes) -> NDArray[Any]:
    """Each pixel's colour as one number, [height, width]."""
    wide = picture.astype(np.uint32)
    packed: NDArray[Any] = wide[..., 0] << 16 | wide[..., 1] << 8 | wide[..., 2]
    return packed


def write_mp4(path: Path, pictures: Iterable[Bytes], size: tuple[int, int], *, fps: float) -> None:
    """Writes an H.264 video.

    Args:
        path: the file; an existing file is replaced.
        pictures: uint8 [height, width, 3] each, RGB.
        size: (width, height) in pixels, both even.
        fps: pictures per second.
    """
    from imageio_ffmpeg import write_frames

    with TemporaryDirectory() as folder:
        partial = Path(folder) / "film.mp4"
        video: Any = write_frames(
            partial, size, fps=fps, codec="libx264", quality=8, macro_block_size=2, ffmpeg_log_level="error"
        )
        with closing(video):
            video.send(None)
            last = None
            for last in pictures:
                video.send(np.ascontiguousarray(last))
            for _ in range(round(HOLD_S * fps) - 1):
                video.send(np.ascontiguousarray(last))

        def write(file: BinaryIO) -> None:
            with open(partial, "rb") as written:
                shutil.copyfileobj(written, file)

        write_atomically(path, write)
