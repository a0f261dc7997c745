"""The classes of cells and their colours."""

from colorsys import hsv_to_rgb
from typing import Final

GROUND, WALL, APPLE, MARK, BEAM, OTHER, SELF, HIDDEN = range(8)
"""The classes; MARK is a heading mark. Under `agents_apart`, each agent has a class from `FIRST_AGENT` on."""

FIRST_AGENT: Final = 8
MAX_AGENTS_APART: Final = 128 - FIRST_AGENT
"""The largest number of agents under `agents_apart`: a class takes seven bits of a paint."""

CLASS_NAMES: Final = ("ground", "wall", "apple", "heading", "beam", "other", "self", "hidden")

Colour = tuple[int, int, int]

COLOURS: Final[tuple[Colour, ...]] = (
    (10, 10, 10),
    (125, 125, 125),
    (0, 255, 0),
    (50, 50, 50),
    (255, 204, 51),
    (255, 0, 0),
    (0, 0, 255),
    (0, 0, 0),
)
"""Red, green and blue of each class [W, run]; HIDDEN is ours."""

AGENT_COLOURS: Final[tuple[Colour, ...]] = (
    (86, 156, 255),
    (255, 92, 92),
    (255, 201, 60),
    (186, 110, 255),
    (64, 214, 200),
    (255, 140, 40),
    (255, 130, 200),
    (200, 220, 90),
)


def agent_colour(agent: int) -> Colour:
    """An agent's identity colour (red, green, blue), 0..255: eight distinct colours, then hues in between."""
    if agent < len(AGENT_COLOURS):
        return AGENT_COLOURS[agent]
    red, green, blue = hsv_to_rgb(agent * 0.618034 % 1, 0.65, 1.0)
    return round(255 * red), round(255 * green), round(255 * blue)


def class_name(kind: int) -> str:
    """The name of a class; an agent's class has the agent's name."""
    return CLASS_NAMES[kind] if kind < FIRST_AGENT else f"agent_{kind - FIRST_AGENT}"


def class_colour(kind: int) -> Colour:
    """The colour of a class; an agent's class has the agent's identity colour."""
    return COLOURS[kind] if kind < FIRST_AGENT else agent_colour(kind - FIRST_AGENT)
