"""The classes of cells, and the colours in which agents observe them.

Agents learn from these colours, which are those of the study: an agent sees itself in blue and others in red,
whoever they are. Pictures for people have colours of their own, in `cprl.pictures.colours`.
"""

from colorsys import hsv_to_rgb
from typing import Final

GROUND, WALL, APPLE, MARK, BEAM, OTHER, SELF = range(7)
WATER, WASTE, CLEANING = range(8, 11)
"""The classes; MARK is a heading mark, CLEANING the beam that cleans. Under `agents_apart`, each agent has a
class from `FIRST_AGENT` on. No cell has class 7, which is left out so that stored boards stay readable."""

FIRST_AGENT: Final = 11
MAX_AGENTS_APART: Final = 120
"""The largest number of agents under `agents_apart`: a class takes eight bits of a paint."""

CLASS_NAMES: Final = (
    *("ground", "wall", "apple", "heading", "beam", "other", "self", "unused"),
    *("water", "waste", "cleaning"),
)

Colour = tuple[int, int, int]
"""Red, green and blue, 0..255."""

COLOURS: Final[tuple[Colour, ...]] = (
    (10, 10, 10),
    (125, 125, 125),
    (0, 255, 0),
    (50, 50, 50),
    (255, 204, 51),
    (255, 0, 0),
    (0, 0, 255),
    (0, 0, 0),
    (70, 120, 170),
    (113, 75, 24),
    (100, 255, 255),
)
"""The colour of each class in windows [W, run]; from WATER on they are ours."""

_APART_COLOURS: Final[tuple[Colour, ...]] = (
    (86, 156, 255),
    (255, 92, 92),
    (255, 201, 60),
    (186, 110, 255),
    (64, 214, 200),
    (255, 140, 40),
    (255, 130, 200),
    (200, 220, 90),
)
"""The colours of other agents in windows under `agents_apart`; stored agents learned from them, so they stay
as they are."""


def class_name(kind: int) -> str:
    """Return the name of a class; an agent's class has the agent's name."""
    return CLASS_NAMES[kind] if kind < FIRST_AGENT else f"agent_{kind - FIRST_AGENT}"


def class_colour(kind: int) -> Colour:
    """Return the colour of a class in windows; under `agents_apart` each agent has one of its own: eight
    distinct ones, then hues in between."""
    if kind < FIRST_AGENT:
        return COLOURS[kind]
    agent = kind - FIRST_AGENT
    if agent < len(_APART_COLOURS):
        return _APART_COLOURS[agent]
    red, green, blue = hsv_to_rgb(agent * 0.618034 % 1, 0.65, 1.0)
    return round(255 * red), round(255 * green), round(255 * blue)
