"""The board of a map as SVG."""

from collections.abc import Sequence
from typing import Final

from cprl.commons.cells import APPLE, GROUND, WALL, WASTE, WATER, Colour
from cprl.commons.maps import Map
from cprl.pictures.colours import PALETTE, agent_colour

_CELL: Final = 20
_WIDEST: Final = 640
"""The pixels of a cell, and the largest width of a picture in pixels."""


def board_svg(board: Map) -> str:
    """Return a board as an episode begins, all apples on it, as SVG."""
    wide = board.width * _CELL
    high = board.height * _CELL
    parts = [_square((0, 0), PALETTE[GROUND], across=wide, down=high)]
    for places, kind, inset in (
        (board.walls, WALL, 0),
        (board.river, WATER, 0),
        ([board.river[index] for index in board.waste], WASTE, 0),
        (board.sites, APPLE, 2),
    ):
        parts += [_square(place, PALETTE[kind], inset=inset) for place in places]
    for agent, (row, col, heading) in enumerate(board.starts):
        parts.append(_square((row, col), agent_colour(agent), inset=1))
        x = (col + 0.5) * _CELL
        y = (row + 0.5) * _CELL
        tip = f'<path d="M0 -9l3 4h-6z" transform="translate({x:g} {y:g}) rotate({90 * heading})"/>'
        parts.append(tip + f'<text x="{x:g}" y="{y:g}">{agent}</text>')
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {wide} {high}" role="img" '
        f'width="{min(wide, _WIDEST)}" style="max-width:100%;height:auto" aria-label="{board!r}" '
        'font-family="sans-serif" font-weight="bold" font-size="11" text-anchor="middle" '
        f'dominant-baseline="central">{"".join(parts)}</svg>'
    )


def _square(
    place: Sequence[int], colour: Colour, *, inset: int = 0, across: int = _CELL, down: int = _CELL
) -> str:
    x = place[1] * _CELL + inset
    y = place[0] * _CELL + inset
    fill = "".join(f"{part:02x}" for part in colour)
    return f'<rect x="{x}" y="{y}" width="{across - 2 * inset}" height="{down - 2 * inset}" fill="#{fill}"/>'
