"""Draws an episode turn by turn, as films show it: its board, its apples and its harvests in one picture."""

from collections.abc import Sequence
from functools import cache
from math import ceil
from pathlib import Path
from typing import Any, Final

import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from cprl.commons.cells import APPLE, GROUND, Colour
from cprl.commons.maps import Map
from cprl.commons.world import WorldView
from cprl.pictures.colours import PALETTE, agent_colour
from cprl.pictures.image import world_image
from cprl.values.array_types import Int32, Int64, UInt8

SMALLEST_WIDTH: Final = 240
"""The smallest width of a run's panel, in pixels."""
DEFAULT_WIDTH: Final = 640
LARGEST_WIDTH: Final = 1920
"""The largest width of a film, in pixels."""

SMALLEST_CELL_PIXELS: Final = 8
"""The smallest size in which a cell is drawn. A board that does not fit then is drawn so, and scaled down."""

_BOARD_HEIGHT: Final = 2
"""The largest height of the board, as a multiple of the picture's width."""
_PLOT_HEIGHT: Final = 7
"""The height of a plot in units; a unit is the height of small text."""
_DIAMOND_RADIUS: Final = 0.72
"""The distance of the corners of a violator's diamond from the middle of its cell, in cells."""
_TEXT: Final = (228, 231, 236)
_FAINT: Final = (140, 146, 158)
_LINE: Final = (52, 56, 66)
_DEAD: Final = (255, 122, 60)


class EpisodePicture:
    """Draws the turns of an episode: a title, the board, its apples, and the harvest of each agent so far.

    Args:
        board: the map of the game.
        steps: the length of the axis of turns, which is that of the longest possible episode.
        width: the width of the picture in pixels, 240 to 1920.
        most_harvested: the top of the axis of harvests, in apples; 0 if it is unknown, then the axis grows
            with the episode.
        height: the smallest height of the picture in pixels, so that pictures of different boards can be
            equally high; by default the picture is as high as its content.
    """

    def __init__(
        self,
        board: Map,
        *,
        steps: int,
        width: int,
        most_harvested: int = 0,
        height: int = 0,
    ) -> None:
        width -= width % 2  # videos need even sizes
        self.board = board
        self.steps = steps
        self._most_harvested = most_harvested
        self._unit = unit = max(10, width // 40)
        """The height of small text, by which all else is measured."""
        self._font = _font(unit)
        self._large_font = _font(2 * unit)
        self._cell_pixels, self._board_size = _board_size(board, width - unit, _BOARD_HEIGHT * width)
        self._plot_width = (width - 3 * unit) // 2
        digits = len(str(most_harvested or 1000))
        self._legend_item_width = int(self._font.getlength(f"00 {'0' * digits}  "))
        self._legend_columns = max(1, self._plot_width // self._legend_item_width)
        legend_rows = ceil(len(board.starts) / self._legend_columns)
        self._line_height = line = unit + unit // 2
        self._title_height = 5 * unit
        self._plot_height = _PLOT_HEIGHT * unit
        below = unit // 2 + 5 * unit // 2 + line * (1 + legend_rows) + self._plot_height + 2 * line
        height = max(height, self._title_height + self._board_size[1] + below)
        self.size: tuple[int, int] = width, height + height % 2
        """The width and height in pixels, both even."""
        self._numbers_top = self.size[1] - below + unit // 2
        self._axes_top = self.size[1] - 2 * line - self._plot_height
        self._middle = (self._title_height + self.size[1] - below) // 2
        self._board_top = self._middle - self._board_size[1] // 2

    def draw(
        self,
        boards: Sequence[WorldView],
        title: str,
        *,
        headline: str = "",
        end: str = "",
        card: str = "",
        violators: Sequence[int] = (),
    ) -> UInt8:
        """Return the picture after the latest turn.

        Args:
            boards: the episode so far: the board at the start and after each turn.
            title: the title; its size is reduced until it fits.
            headline: the result of the whole episode, which stands below the title.
            end: how the episode ended, in orange beside the title; if "", the turn stands there.
            card: how the episode ended, in large letters across the board; "" for no card.
            violators: the indices of the agents that broke a rule, which get a white diamond.

        Returns:
            uint8 [height, width, 3], RGB.
        """
        image = Image.new("RGB", self.size, PALETTE[GROUND])
        draw = ImageDraw.Draw(image)
        self._caption(draw, title, headline, end, f"turn {len(boards) - 1:,} of {self.steps:,}")
        board_image = Image.fromarray(world_image(self.board, boards[-1], cell_pixels=self._cell_pixels))
        if board_image.size != self._board_size:
            board_image = board_image.resize(self._board_size, Image.Resampling.BOX)
        image.paste(board_image, ((self.size[0] - self._board_size[0]) // 2, self._board_top))
        for agent in violators:
            self._mark_violator(draw, agent, boards[-1])
        if card:
            colour = _DEAD if end else _TEXT
            self._card(draw, card, colour)
        self._plot_stock(draw, np.array([board.stock.sum(dtype=np.int64) for board in boards]))
        self._plot_harvests(draw, np.array([board.harvested for board in boards]))
        return np.asarray(image)

    def _mark_violator(self, draw: ImageDraw.ImageDraw, agent: int, board: WorldView) -> None:
        """Draw a diamond around an agent that broke a rule, as `cprl.viewer.replay_views` does.

        An agent that is out of play, because a sanction took effect at once, also gets its number.
        """
        left, top, right, bottom = self.cell_box(int(board.row[agent]), int(board.col[agent]))
        centre = (left + right) / 2, (top + bottom) / 2
        circle = *centre, (right - left) * _DIAMOND_RADIUS
        draw.regular_polygon(circle, 4, 45, outline=_TEXT, width=max(1, self._unit // 5))
        if not board.in_play[agent]:
            draw.text(centre, str(agent), agent_colour(agent), self._font, anchor="mm")

    def cell_box(self, row: int, col: int) -> tuple[float, float, float, float]:
        """Return the left, top, right and bottom edge of a cell in the picture, in pixels."""
        board_width, board_height = self._board_size
        left = (self.size[0] - board_width) // 2
        cell_width = board_width / self.board.width
        cell_height = board_height / self.board.height
        top = self._board_top + row * cell_height
        return left + col * cell_width, top, left + (col + 1) * cell_width, top + cell_height

    def _caption(self, draw: ImageDraw.ImageDraw, title: str, headline: str, end: str, turn: str) -> None:
        """Write the title on the left, the turn or the end on the right, and the result below them."""
        edge = self._unit
        middle = 3 * self._unit // 2
        below = _fitting(headline, self.size[0] - 2 * edge, 5 * self._unit // 4)
        draw.text((edge, 15 * self._unit // 4), headline, _TEXT, below, anchor="lm")
        state, colour = (end, _DEAD) if end else (turn, _TEXT)
        font = _fitting(state, (self.size[0] - 3 * edge) / 2, 4 * self._unit // 3)
        draw.text((self.size[0] - edge, middle), state, colour, font, anchor="rm")
        room = self.size[0] - 3 * edge - font.getlength(state)
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
        """Draw each agent's harvest so far, [T, N], as a line in its colour, and a legend of the numbers."""
        left = 2 * self._unit + self._plot_width
        most = self._most_harvested or int(harvests.max(initial=0))
        self._axes(draw, left, f"{harvests[-1].sum():,}", f"apples picked; below by each, 0 to {most:,}")
        for agent in range(harvests.shape[1]):
            path = self._points(left, harvests[:, agent], most)
            draw.line(path, agent_colour(agent), max(1, self._unit // 6))
        top = self._axes_top - self._line_height * ceil(harvests.shape[1] / self._legend_columns)
        line = int(self._font.getbbox("0")[3] * 1.3) + 1
        for agent, apples in enumerate(harvests[-1]):
            row, column = divmod(agent, self._legend_columns)
            x = left + column * self._legend_item_width
            y = top + row * line
            unit = self._unit
            patch_width = max(unit, int(self._font.getlength(f"{agent}")) + 4)
            draw.rectangle((x, y, x + patch_width, y + unit + 1), agent_colour(agent))
            middle_y = y + unit / 2 + 1
            draw.text((x + patch_width / 2, middle_y), f"{agent}", PALETTE[GROUND], self._font, anchor="mm")
            draw.text((x + patch_width + unit // 3, middle_y), f"{apples}", _TEXT, self._font, anchor="lm")

    def _axes(self, draw: ImageDraw.ImageDraw, left: int, number: str, unit: str) -> None:
        """Draw the frame of a plot over turns, and above it a large number with its unit."""
        top = self._axes_top
        floor = top + self._plot_height
        right = left + self._plot_width
        below = floor + self._unit // 4
        draw.text((left, self._numbers_top), number, _TEXT, self._large_font)
        under = self._numbers_top + 5 * self._unit // 2
        draw.text((left, under), unit, _FAINT, _fitting(unit, self._plot_width, self._unit))
        draw.rectangle((left, top, right, floor), outline=_LINE)
        draw.text((left, below), "0", _FAINT, self._font)
        draw.text((left + self._plot_width / 2, below), "turn", _FAINT, self._font, anchor="ma")
        draw.text((right, below), f"{self.steps:,}", _FAINT, self._font, anchor="ra")

    def _points(self, left: int, values: NDArray[Any], most: int) -> list[tuple[float, float]]:
        """Return the points (x, y) of values [T] from 0 to `most` in a plot, at least two."""
        height = self._plot_height
        x = left + np.arange(len(values)) * (self._plot_width / max(1, self.steps))
        y = self._axes_top + height - values * (height / max(1, most))
        points = list(zip(x.tolist(), y.tolist(), strict=True))
        return points if len(points) > 1 else points * 2


def _board_size(board: Map, width: int, height: int) -> tuple[int, tuple[int, int]]:
    """Return the size of a cell, and the width and height of the board, in pixels, so that it fits the room.

    If the board does not fit with the smallest cells, it is drawn with them and scaled down to this size.
    """
    largest_cell = min((width - 1) // board.width, (height - 1) // board.height)
    cell = max(SMALLEST_CELL_PIXELS, largest_cell)
    drawn_width = board.width * cell + 1
    drawn_height = board.height * cell + 1
    scale = min(1.0, width / drawn_width, height / drawn_height)
    return cell, (max(1, int(drawn_width * scale)), max(1, int(drawn_height * scale)))


@cache
def _font(pixels: int) -> ImageFont.FreeTypeFont:
    """Return the font DejaVu Sans of matplotlib: Pillow's default font has only English letters."""
    return ImageFont.truetype(Path(matplotlib.get_data_path(), "fonts/ttf/DejaVuSans.ttf"), pixels)


def _fitting(text: str, room: float, largest: int) -> ImageFont.FreeTypeFont:
    """Return the font in the largest size, at most `largest` pixels, in which a text fits the room."""
    text_width = _font(largest).getlength(text)
    size = largest
    if text_width > room:
        size = max(1, int(largest * room / text_width))
    return _font(size)


def note(text: str, width: int) -> UInt8:
    """Return the image of a small text below the pictures, uint8 [height, width, 3]; the height is even."""
    edge = max(10, width // 96)
    font = _font(max(10, min(14, width // 60)))
    room = width - 2 * edge
    lines = [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".strip()
        lines[-1:] = [longer] if font.getlength(longer) <= room else [lines[-1], word]
    line_height = int(font.size * 1.4)
    height = line_height * len(lines) + edge
    image = Image.new("RGB", (width, height + height % 2), PALETTE[GROUND])
    spacing = line_height - font.size
    ImageDraw.Draw(image).multiline_text((edge, 0), "\n".join(lines), _FAINT, font, spacing=spacing)
    return np.asarray(image)
