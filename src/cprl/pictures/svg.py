"""Draw the board of a map as SVG, e.g. for notebooks."""

from collections.abc import Sequence
from typing import Final

from cprl.commons.cells import APPLE, GROUND, WALL, WASTE, WATER, Colour
from cprl.commons.maps import Map
from cprl.pictures.colours import PALETTE, agent_colour

_CELL_PIXELS: Final = 20
"""The width and height of a cell."""
_LARGEST_WIDTH_PIXELS: Final = 640
"""The largest width at which a picture is shown."""


def board_svg(board: Map) -> str:
    """Return an SVG picture of a board as an episode begins on it, with an apple on every site."""
    width = board.width * _CELL_PIXELS
    height = board.height * _CELL_PIXELS
    elements = [_rectangle((0, 0), PALETTE[GROUND], width=width, height=height)]
    for cells, cell_class, inset in (
        (board.walls, WALL, 0),
        (board.river, WATER, 0),
        ([board.river[index] for index in board.waste], WASTE, 0),
        (board.sites, APPLE, 2),
    ):
        elements += [_rectangle(cell, PALETTE[cell_class], inset=inset) for cell in cells]
    for agent, (row, col, heading) in enumerate(board.starts):
        elements.append(_rectangle((row, col), agent_colour(agent), inset=1))
        x = (col + 0.5) * _CELL_PIXELS
        y = (row + 0.5) * _CELL_PIXELS
        triangle = f'<path d="M0 -9l3 4h-6z" transform="translate({x:g} {y:g}) rotate({90 * heading})"/>'
        elements.append(triangle + f'<text x="{x:g}" y="{y:g}">{agent}</text>')
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img" '
        f'width="{min(width, _LARGEST_WIDTH_PIXELS)}" style="max-width:100%;height:auto" '
        f'aria-label="{board!r}" '
        'font-family="sans-serif" font-weight="bold" font-size="11" text-anchor="middle" '
        f'dominant-baseline="central">{"".join(elements)}</svg>'
    )


def _rectangle(
    cell: Sequence[int],
    colour: Colour,
    *,
    inset: int = 0,
    width: int = _CELL_PIXELS,
    height: int = _CELL_PIXELS,
) -> str:
    """Return a rectangle from the top left of a cell (row, col) on, made smaller by `inset` pixels on each
    side."""
    x = cell[1] * _CELL_PIXELS + inset
    y = cell[0] * _CELL_PIXELS + inset
    fill = "".join(f"{component:02x}" for component in colour)
    size = f'width="{width - 2 * inset}" height="{height - 2 * inset}"'
    return f'<rect x="{x}" y="{y}" {size} fill="#{fill}"/>'
