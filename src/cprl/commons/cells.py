"""The classes of cells on a board, and the colours in which agents observe them.

Agents learn from these colours, which are those of the published study: every agent sees itself in blue and
all others in red. Pictures for people use other colours, see `cprl.pictures.colours`.
"""

from colorsys import hsv_to_rgb
from typing import Final

GROUND, WALL, APPLE, MARK, BEAM, OTHER, SELF = range(7)
WATER, WASTE, CLEANING = range(8, 11)
"""The classes of cells. MARK shows the heading of an agent, CLEANING the beam that cleans a river. Under
`Observation.agents_apart`, agent i has the class `FIRST_AGENT` + i. Class 7 is unused, so that the numbers in
stored boards keep their meaning."""

FIRST_AGENT: Final = 11
MAX_AGENTS_APART: Final = 120
"""The largest number of agents under `agents_apart`, since a class has to fit into eight bits of a paint."""

CLASS_NAMES: Final = (
    *("ground", "wall", "apple", "heading", "beam", "other", "self", "unused"),
    *("water", "waste", "cleaning"),
)

Colour = tuple[int, int, int]
"""Red, green and blue, 0..255."""

CLASS_COLOURS: Final[tuple[Colour, ...]] = (
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
"""The colour of each class in windows: of the study [W, run] up to SELF, of cprl from WATER on."""

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
"""The colours of the first agents in windows under `agents_apart`. Stored agents have learned from them, so
they must not change."""


def class_name(kind: int) -> str:
    """Return the name of a class of cells, for an agent's class the name of the agent."""
    return CLASS_NAMES[kind] if kind < FIRST_AGENT else f"agent_{kind - FIRST_AGENT}"


def class_colour(kind: int) -> Colour:
    """Return the colour of a class of cells in windows.

    Under `agents_apart` each agent has its own colour: the first eight are chosen by hand, further ones are
    hues spread by the golden ratio.
    """
    if kind < FIRST_AGENT:
        return CLASS_COLOURS[kind]
    agent = kind - FIRST_AGENT
    if agent < len(_APART_COLOURS):
        return _APART_COLOURS[agent]
    red, green, blue = hsv_to_rgb(agent * 0.618034 % 1, 0.65, 1.0)
    return round(255 * red), round(255 * green), round(255 * blue)
