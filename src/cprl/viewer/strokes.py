"""Agents as lines on Rerun's board: the number inside the cell, a triangle for the heading, a second mark.

Rerun writes a label beside what it belongs to, on a neighbouring cell. Lines stay in their cell at any zoom.
"""

from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cprl.commons.colours import agent_mark
from cprl.commons.sprites import DIGIT_HIGH, POINTS, number_paths

RADIUS_CELLS: Final = 0.045
"""Half the width of a line, in cells."""

OUT_HALF_CELLS: Final = 0.4
OUT_STROKE_CELLS: Final = 0.07
"""Half the side of the square of an agent out of play, and half the width of its line, in cells."""

_EDGE, _RIM, _DEEP, _HALF_WIDE, _GRID = 0.44, 0.09, 0.15, 0.16, 0.09
"""In cells: the distance of the triangle's tip from the middle; the width of a ring or stripe; the triangle's
depth and half its width; the largest distance between points of a digit."""
_TURNS: Final = np.array([[(1, 0), (0, 1)], [(0, 1), (-1, 0)], [(-1, 0), (0, -1)], [(0, -1), (1, 0)]])
"""What a heading makes of right and down, as seen by somebody headed up."""

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Strokes:
    """Lines of some agents, for each heading."""

    owner: NDArray[np.intp]
    """The agent of each line [S]."""
    shape: Floats
    """float32 [4, S, P, 2], the corners (x, y) of each line, in cells from the middle of the agent's cell."""

    def placed(
        self, centres: Floats, heading: NDArray[np.integer], drawn: NDArray[np.bool_]
    ) -> tuple[Floats, NDArray[np.intp]]:
        """The lines of all frames.

        Args:
            centres: float32 [T, N, 2], the middle of each agent's cell, (x, y).
            heading: int [T, N].
            drawn: bool [T, N], the agents whose lines are drawn.

        Returns:
            The lines one after the other, float32 [lines, P, 2], and how many each frame has, [T].
        """
        return self.placed_lines(centres, heading, drawn[:, self.owner])

    def placed_lines(
        self, centres: Floats, heading: NDArray[np.integer], drawn: NDArray[np.bool_]
    ) -> tuple[Floats, NDArray[np.intp]]:
        """`placed` for the lines that are drawn, bool [T, S], in place of agents."""
        frame, line = np.nonzero(drawn)
        agent = self.owner[line]
        lines = self.shape[heading[frame, agent], line] + centres[frame, agent][:, None]
        return lines, drawn.sum(1)


@cache
def numbers_and_headings(agents: int) -> Strokes:
    """The number and the triangle of each agent."""
    lines = [(agent, _triangle(agent)) for agent in range(agents)]
    lines += [(agent, digit) for agent in range(agents) for digit in _number(agent)]
    return _strokes(lines)


@cache
def numbers(agents: int) -> Strokes:
    """The number of each agent in the middle of its cell."""
    middle = [
        (agent, np.broadcast_to(digit * _scale(agent, room=0.7), (4, POINTS, 2)))
        for agent in range(agents)
        for digit in number_paths(agent)
    ]
    return _strokes(middle)


@cache
def marks(agents: int) -> Strokes:
    """The second marks, from agent 4 on."""
    return _strokes([(agent, line) for agent in range(agents) for line in _mark(agent_mark(agent))])


@cache
def squares(agents: int) -> Strokes:
    """A hollow square in the cell of each agent."""
    far = OUT_HALF_CELLS
    square = _turned((-far, -far), (far, -far), (far, far), (-far, far), (-far, -far))
    return _strokes([(agent, square) for agent in range(agents)])


def _strokes(lines: list[tuple[int, Floats]]) -> Strokes:
    shape = np.zeros((4, len(lines), POINTS, 2), np.float32)
    for index, (_, line) in enumerate(lines):
        shape[:, index, : line.shape[1]], shape[:, index, line.shape[1] :] = line, line[:, -1:]
    return Strokes(np.array([agent for agent, _ in lines], np.intp), shape)


def _turned(*corners: tuple[float, float]) -> Floats:
    """A line of an agent that is headed up, for each heading: [4, corners, 2]."""
    turned: Floats = np.einsum("pk,hkd->hpd", np.array(corners), _TURNS).astype(np.float32)
    return turned


def _front(agent: int) -> float:
    """How far the tip of the triangle is from the middle, in cells."""
    return _EDGE - (_RIM if agent_mark(agent) == "ring" else 0)


def _triangle(agent: int) -> Floats:
    tip = _front(agent)
    base = tip - _DEEP
    inside = (0.0, -base - 0.4 * _DEEP)
    return _turned((-_HALF_WIDE, -base), (0, -tip), (_HALF_WIDE, -base), (-_HALF_WIDE, -base), inside)


def _number(agent: int) -> list[Floats]:
    """The digits behind the triangle: a number is upright whatever the heading."""
    front = _front(agent) - _DEEP - 2 * RADIUS_CELLS
    back = 0.5 - (_RIM if agent_mark(agent) in ("ring", "stripe") else 0.02)
    behind = _turned((0, (back - front) / 2))
    return [behind + digit * np.float32(_scale(agent, room=back + front)) for digit in number_paths(agent)]


def _scale(agent: int, *, room: float) -> float:
    """The distance between points of a digit with which a number fits, in cells."""
    points = max(DIGIT_HIGH - 1, 4 * len(str(agent)) - 2)
    return min(_GRID, (room - 2 * RADIUS_CELLS) / points)


def _mark(mark: str) -> list[Floats]:
    """The lines of a mark, along the edge of the cell."""
    edge, corner = 0.5 - RADIUS_CELLS, 0.25
    if mark == "ring":
        return [_turned((-edge, -edge), (edge, -edge), (edge, edge), (-edge, edge), (-edge, -edge))]
    if mark == "stripe":
        return [_turned((-edge, edge), (edge, edge))]
    if mark == "corners":
        return [
            _turned((x * corner, y * edge), (x * edge, y * edge), (x * edge, y * corner))
            for x in (-1, 1)
            for y in (-1, 1)
        ]
    return []
