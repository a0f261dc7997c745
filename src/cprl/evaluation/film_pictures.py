"""The pictures of a film: one population's board, stock and harvests so far; and its files."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from functools import cache
from importlib.util import find_spec
from math import ceil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from cprl.commons.cells import APPLE, GROUND, Colour
from cprl.commons.maps import Map
from cprl.commons.world import Shown
from cprl.pictures.colours import PALETTE, agent_colour
from cprl.pictures.image import world_image
from cprl.runs.files import write_atomically
from cprl.values.arrays import Int32, Int64, UInt8

SMALLEST_WIDTH: Final = 240
DEFAULT_WIDTH: Final = 640
LARGEST_WIDTH: Final = 1920
"""Pixels."""

SMALLEST_CELL_PIXELS: Final = 8
"""Boards with more cells than fit in this size are drawn with it, and then made smaller."""

_BOARD_HEIGHT: Final = 2
"""The height of the board in the picture, at most, as a multiple of the picture's width."""
_PLOT_HEIGHT: Final = 7
"""In units, which are the height of small text."""
_DIAMOND_BEYOND: Final = 0.22
"""How far a violator's diamond goes beyond its cell, in cells."""
_TEXT: Final = (228, 231, 236)
_FAINT: Final = (140, 146, 158)
_LINE: Final = (52, 56, 66)
_DEAD: Final = (255, 122, 60)


class EpisodePicture:
    """Draws any turn of an episode: a title, the board, the apples on it and each agent's harvest so far.

    Args:
        steps: the length of the turn axis, in turns: the longest that an episode can be.
        width: of the picture in pixels, 240 to 1920.
        most_harvested: the top of the axis of harvests, in apples; 0 where it is not known before, so that
            the axis grows with the episode.
        height: of the picture in pixels, at least what it takes, so that different boards can stand side by
            side; by default what it takes.
    """

    def __init__(
        self,
        board: Map,
        *,
        steps: int,
        width: int = DEFAULT_WIDTH,
        most_harvested: int = 0,
        height: int = 0,
    ) -> None:
        width -= width % 2  # which videos want
        self.board = board
        self.steps = steps
        self._most = most_harvested
        self._unit = unit = max(10, width // 40)
        self._font = _font(unit)
        self._large = _font(2 * unit)
        highest = _BOARD_HEIGHT * width
        room = width - unit
        fitting = min((room - 1) // board.width, (highest - 1) // board.height)
        self._cell = max(SMALLEST_CELL_PIXELS, fitting)
        wide = board.width * self._cell + 1
        high = board.height * self._cell + 1
        shrink = min(1.0, room / wide, highest / high)
        self._board_size = max(1, int(wide * shrink)), max(1, int(high * shrink))
        self._half = (width - 3 * unit) // 2
        digits = len(str(most_harvested or 1000))
        self._item = int(self._font.getlength(f"00 {'0' * digits}  "))
        self._in_a_row = max(1, self._half // self._item)
        rows = ceil(len(board.starts) / self._in_a_row)
        self._line = line = unit + unit // 2
        self._title_height = 5 * unit
        self._plot_height = _PLOT_HEIGHT * unit
        below = unit // 2 + 5 * unit // 2 + line * (1 + rows) + self._plot_height + 2 * line
        height = max(height, self._title_height + self._board_size[1] + below)
        self.size: tuple[int, int] = width, height + height % 2
        """The width and height in pixels, both even."""
        self._numbers_top = self.size[1] - below + unit // 2
        self._axes_top = self.size[1] - 2 * line - self._plot_height
        self._middle = (self._title_height + self.size[1] - below) // 2
        self._board_top = self._middle - self._board_size[1] // 2

    def draw(
        self,
        moments: Sequence[Shown],
        title: str,
        *,
        comes_to: str = "",
        end: str = "",
        card: str = "",
        violators: Sequence[int] = (),
    ) -> UInt8:
        """Return the picture of the last of these moments.

        Args:
            moments: the episode so far: the board as it began, then after each turn.
            title: what is shown, in large type; smaller where the room ends.
            comes_to: what the whole episode comes to, below the title.
            end: how the episode ended, beside the title and in orange; the turn while this is empty.
            card: how the episode ended, in large type across the board.
            violators: the indices of agents that get a white diamond, since they broke a rule.

        Returns:
            uint8 [height, width, 3], RGB.
        """
        image = Image.new("RGB", self.size, PALETTE[GROUND])
        draw = ImageDraw.Draw(image)
        self._caption(draw, title, comes_to, end, f"turn {len(moments) - 1:,} of {self.steps:,}")
        drawn = Image.fromarray(world_image(self.board, moments[-1], cell_pixels=self._cell))
        if drawn.size != self._board_size:
            drawn = drawn.resize(self._board_size, Image.Resampling.BOX)
        image.paste(drawn, ((self.size[0] - self._board_size[0]) // 2, self._board_top))
        for agent in violators:
            self._mark(draw, agent, moments[-1])
        if card:
            self._card(draw, card, _DEAD if end else _TEXT)
        self._plot_stock(draw, np.array([moment.stock.sum(dtype=np.int64) for moment in moments]))
        self._plot_harvests(draw, np.array([moment.harvested for moment in moments]))
        return np.asarray(image)

    def _mark(self, draw: ImageDraw.ImageDraw, agent: int, now: Shown) -> None:
        """Draw a diamond around who broke a rule, as `cprl.viewer.replay` has it; with its number where it is
        out of play, as a sanction can put it at once."""
        left, top, right, bottom = self.cell_box(int(now.row[agent]), int(now.col[agent]))
        across = (left + right) / 2
        down = (top + bottom) / 2
        more = (right - left) * _DIAMOND_BEYOND
        corners = [(across, top - more), (right + more, down), (across, bottom + more), (left - more, down)]
        draw.line([*corners, *corners[:2]], _TEXT, max(1, self._unit // 5), joint="curve")
        if not now.in_play[agent]:
            draw.text((across, down), str(agent), agent_colour(agent), self._font, anchor="mm")

    def cell_box(self, row: int, col: int) -> tuple[float, float, float, float]:
        """Return where a cell is in the picture: left, top, right and bottom in pixels."""
        wide, high = self._board_size
        left = (self.size[0] - wide) // 2
        across = wide / self.board.width
        down = high / self.board.height
        top = self._board_top + row * down
        return left + col * across, top, left + (col + 1) * across, top + down

    def _caption(self, draw: ImageDraw.ImageDraw, title: str, comes_to: str, end: str, turn: str) -> None:
        """Write the title on the left, the turn or the end on the right; below them what the episode comes
        to."""
        edge = self._unit
        middle = 3 * self._unit // 2
        below = _fitting(comes_to, self.size[0] - 2 * edge, 5 * self._unit // 4)
        draw.text((edge, 15 * self._unit // 4), comes_to, _TEXT, below, anchor="lm")
        words, colour = (end, _DEAD) if end else (turn, _TEXT)
        font = _fitting(words, (self.size[0] - 3 * edge) / 2, 4 * self._unit // 3)
        draw.text((self.size[0] - edge, middle), words, colour, font, anchor="rm")
        room = self.size[0] - 3 * edge - font.getlength(words)
        draw.text((edge, middle), title, _TEXT, _fitting(title, room, 2 * self._unit), anchor="lm")

    def _card(self, draw: ImageDraw.ImageDraw, text: str, colour: Colour) -> None:
        edge = self._unit
        right = self.size[0] - edge
        draw.rectangle(
            (edge, self._middle - 2 * edge, right, self._middle + 2 * edge), PALETTE[GROUND], colour
        )
        font = _fitting(text, right - 3 * edge, 2 * edge)
        draw.text((self.size[0] / 2, self._middle), text, colour, font, anchor="mm")

    def _plot_stock(self, draw: ImageDraw.ImageDraw, stock: Int64) -> None:
        """Draw the apples on the board, [T], as an area."""
        left = self._unit
        sites = len(self.board.sites)
        self._axes(draw, left, f"{stock[-1]:,} of {sites:,}", "apples on the board")
        path = self._points(left, stock, sites)
        floor = self._axes_top + self._plot_height
        draw.polygon([(path[0][0], floor), *path, (path[-1][0], floor)], PALETTE[APPLE], PALETTE[APPLE])

    def _plot_harvests(self, draw: ImageDraw.ImageDraw, harvests: Int32) -> None:
        """Draw each agent's harvest so far, [T, N], as a line in its colour, which a legend repeats."""
        left = 2 * self._unit + self._half
        most = self._most or int(harvests.max(initial=0))
        words = f"apples picked; below by each, 0 to {most:,}"
        self._axes(draw, left, f"{harvests[-1].sum():,}", words)
        for agent in range(harvests.shape[1]):
            path = self._points(left, harvests[:, agent], most)
            draw.line(path, agent_colour(agent), max(1, self._unit // 6))
        top = self._axes_top - self._line * ceil(harvests.shape[1] / self._in_a_row)
        line = int(self._font.getbbox("0")[3] * 1.3) + 1
        for agent, apples in enumerate(harvests[-1]):
            row, place = divmod(agent, self._in_a_row)
            across = left + place * self._item
            down = top + row * line
            unit = self._unit
            wide = max(unit, int(self._font.getlength(f"{agent}")) + 4)
            draw.rectangle((across, down, across + wide, down + unit + 1), agent_colour(agent))
            middle = across + wide / 2, down + unit / 2 + 1
            draw.text(middle, f"{agent}", PALETTE[GROUND], self._font, anchor="mm")
            draw.text((across + wide + unit // 3, middle[1]), f"{apples}", _TEXT, self._font, anchor="lm")

    def _axes(self, draw: ImageDraw.ImageDraw, left: int, number: str, words: str) -> None:
        """Draw the frame of a plot over turns; above it a large number and what it counts."""
        top = self._axes_top
        floor = top + self._plot_height
        right = left + self._half
        below = floor + self._unit // 4
        draw.text((left, self._numbers_top), number, _TEXT, self._large)
        under = self._numbers_top + 5 * self._unit // 2
        draw.text((left, under), words, _FAINT, _fitting(words, self._half, self._unit))
        draw.rectangle((left, top, right, floor), outline=_LINE)
        draw.text((left, below), "0", _FAINT, self._font)
        draw.text((left + self._half / 2, below), "turn", _FAINT, self._font, anchor="ma")
        draw.text((right, below), f"{self.steps:,}", _FAINT, self._font, anchor="ra")

    def _points(self, left: int, values: NDArray[Any], most: int) -> list[tuple[float, float]]:
        """Return where values [T] of 0 to `most` are in a plot; at least two points."""
        high = self._plot_height
        columns = left + np.arange(len(values)) * (self._half / max(1, self.steps))
        rows = self._axes_top + high - values * (high / max(1, most))
        points = list(zip(columns.tolist(), rows.tolist(), strict=True))
        return points if len(points) > 1 else points * 2


@cache
def _font(pixels: int) -> ImageFont.FreeTypeFont:
    """DejaVu Sans, which matplotlib brings: Pillow's own font has no letters beyond English."""
    return ImageFont.truetype(Path(matplotlib.get_data_path(), "fonts/ttf/DejaVuSans.ttf"), pixels)


def _fitting(text: str, room: float, largest: int) -> ImageFont.FreeTypeFont:
    """Return the font in the largest size, in pixels, in which a text has room."""
    wide = _font(largest).getlength(text)
    return _font(largest if wide <= room else max(1, int(largest * room / wide)))


def note(text: str, width: int) -> UInt8:
    """Return a text in small type, to stand below pictures: uint8 [height, width, 3], the height even."""
    edge = max(10, width // 96)
    font = _font(max(10, min(14, width // 60)))
    room = width - 2 * edge
    lines = [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".strip()
        lines[-1:] = [longer] if font.getlength(longer) <= room else [lines[-1], word]
    line = int(font.size * 1.4)
    high = line * len(lines) + edge
    image = Image.new("RGB", (width, high + high % 2), PALETTE[GROUND])
    ImageDraw.Draw(image).multiline_text((edge, 0), "\n".join(lines), _FAINT, font, spacing=line - font.size)
    return np.asarray(image)


HOLD_S: Final = 2.0
"""How long the last picture stays."""

_COLOURS: Final = 127
"""Of a GIF, so that a pixel takes at most seven bits; one more marks pixels that do not change."""


def check_can_write_mp4(path: Path) -> None:
    """Raise a ModuleNotFoundError, saying how to install it, if imageio-ffmpeg is not installed."""
    if find_spec("imageio_ffmpeg") is None:
        raise ModuleNotFoundError(
            f"{path}: an .mp4 needs imageio-ffmpeg, which is not installed; "
            'run pip install "cprl[film]", or name a .gif'
        )


def write_gif(path: Path, pictures: Iterable[UInt8], samples: Sequence[UInt8], *, fps: float) -> None:
    """Write a GIF that repeats, with one palette for all pictures.

    Args:
        pictures: uint8 [height, width, 3] each, RGB.
        samples: some of the pictures; their most frequent colours are exact, others become the nearest.
        fps: pictures per second; a GIF counts hundredths of a second, so it is rounded to 100 / n.
    """
    counts: Any = Image.fromarray(np.concatenate(samples)).getcolors(2**24)
    known = np.array([colour for _, colour in sorted(counts, reverse=True)[:_COLOURS]])
    palette = known.astype(np.uint8).tobytes() + bytes(3)
    index = np.full(2**24, -1, np.int16)

    def indexed(picture: UInt8) -> Image.Image:
        # Pillow's own quantize takes colours for equal that differ by up to 4.
        packed = picture @ np.array([1 << 16, 1 << 8, 1], np.int32)
        new = np.unique(packed[index[packed] < 0])
        apart = np.stack([new >> 16, new >> 8 & 255, new & 255], -1)[:, None] - known
        index[new] = (apart**2).sum(-1).argmin(1)
        image = Image.fromarray(index[packed].astype(np.uint8), "P")
        image.putpalette(palette)
        return image

    first, *others = map(indexed, pictures)
    options = {
        "append_images": others,
        "duration": [10 * max(2, round(100 / fps))] * len(others) + [round(1000 * HOLD_S)],
        "palette": palette,
        "transparency": len(known),
    }
    write_atomically(
        path, lambda file: first.save(file, format="GIF", save_all=True, loop=0, optimize=True, **options)
    )


def write_mp4(path: Path, pictures: Iterator[UInt8], *, fps: float) -> None:
    """Write an MP4, whose last picture stays for a while."""
    from imageio_ffmpeg import write_frames

    look: Any = {"codec": "libx264", "quality": 8, "macro_block_size": 2, "ffmpeg_log_level": "error"}
    picture = next(pictures)
    high, wide, _ = picture.shape
    with TemporaryDirectory() as folder:
        partial = Path(folder) / "film.mp4"
        with closing(write_frames(partial, (wide, high), fps=fps, **look)) as video:
            video.send(None)
            video.send(np.ascontiguousarray(picture))
            for picture in pictures:
                video.send(np.ascontiguousarray(picture))
            for _ in range(round(HOLD_S * fps) - 1):
                video.send(np.ascontiguousarray(picture))
        write_atomically(path, lambda file: file.write(partial.read_bytes()))
