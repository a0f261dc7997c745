"""The classes of cells, their colours in windows, and the palette of all pictures for people.

Windows keep the study's colours (`COLOURS`), because agents learn from them: there an agent sees itself in
blue and others in red, whoever they are. All other pictures for people, the viewer's, boards, figures and
films, have one palette, in which apples, agents, beams, walls and ground also differ under deuteranopia and
protanopia. Only four hues are that far apart: agents 4 to 7 have those of agents 0 to 3, and a mark.
"""

from colorsys import hsv_to_rgb
from typing import Final

GROUND, WALL, APPLE, MARK, BEAM, OTHER, SELF, HIDDEN, WATER, WASTE, CLEANING = range(11)
"""The classes; MARK is a heading mark, CLEANING the beam that cleans. Under `agents_apart`, each agent has a
class from `FIRST_AGENT` on."""

FIRST_AGENT: Final = 11
MAX_AGENTS_APART: Final = 120
"""The largest number of agents under `agents_apart`: a class takes eight bits of a paint."""

CLASS_NAMES: Final = (
    *("ground", "wall", "apple", "heading", "beam", "other", "self", "hidden"),
    *("water", "waste", "cleaning"),
)

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
    (70, 120, 170),
    (113, 75, 24),
    (100, 255, 255),
)
"""Red, green and blue of each class in windows [W, run]; from HIDDEN on they are ours."""

ORANGE, BLUE, GREEN = (230, 160, 0), (86, 180, 233), (0, 158, 115)
VERMILION, PURPLE, GREY = (213, 94, 0), (204, 121, 167), (150, 150, 150)
"""Of lines and states: M. Okabe and K. Ito's colours, apart for the colour-blind too, and a grey."""

PALETTE: Final[dict[int, Colour]] = {
    GROUND: (16, 18, 22),
    WALL: (70, 74, 84),
    APPLE: (31, 163, 90),
    BEAM: (200, 200, 200),
    WATER: (28, 52, 84),
    WASTE: (124, 88, 40),
    CLEANING: (150, 220, 220),
}
"""Red, green and blue of the classes in pictures for people; agents have `agent_colour`."""

AGENT_COLOURS: Final[tuple[Colour, ...]] = ((86, 180, 233), (230, 97, 0), (240, 228, 66), (204, 121, 167))
"""The hues of agents in pictures for people: blue, orange, yellow, pink."""

MARKS: Final = ("plain", "ring", "stripe", "corners")
"""The second marks: none for agents 0 to 3, a ring for 4 to 7, a stripe on either side for 8 to 11, the four
corners for 12 to 15. From agent 16 on they repeat, and the number alone tells agents apart."""

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
"""Other agents in windows under `agents_apart`; stored agents learned from them, so they stay as they are."""


def agent_colour(agent: int) -> Colour:
    """An agent's hue (red, green, blue), 0..255, in pictures for people; agents 0 and 4 have the same."""
    return AGENT_COLOURS[agent % len(AGENT_COLOURS)]


def line_colour(agent: int) -> Colour:
    """An agent's colour in plots over time, where no mark can stand: the hue, lighter for agents 4 to 7 and
    darker for 8 to 11."""
    tints = ((0, 1.0), (255, 0.4), (0, 0.5))
    towards, share = tints[agent // len(AGENT_COLOURS) % len(tints)]
    red, green, blue = (round(towards + share * (part - towards)) for part in agent_colour(agent))
    return red, green, blue


def agent_mark(agent: int) -> str:
    """An agent's second mark, one of `MARKS`; with the hue it tells sixteen agents apart."""
    return MARKS[agent // len(AGENT_COLOURS) % len(MARKS)]


def picture_colour(kind: int) -> Colour:
    """The colour of a class in pictures for people; classes that only windows have keep the study's."""
    return PALETTE.get(kind, COLOURS[kind]) if kind < FIRST_AGENT else agent_colour(kind - FIRST_AGENT)


def class_name(kind: int) -> str:
    """The name of a class; an agent's class has the agent's name."""
    return CLASS_NAMES[kind] if kind < FIRST_AGENT else f"agent_{kind - FIRST_AGENT}"


def class_colour(kind: int) -> Colour:
    """The colour of a class in windows; under `agents_apart` each agent has one of its own: eight distinct
    ones, then hues in between."""
    if kind < FIRST_AGENT:
        return COLOURS[kind]
    agent = kind - FIRST_AGENT
    if agent < len(_APART_COLOURS):
        return _APART_COLOURS[agent]
    red, green, blue = hsv_to_rgb(agent * 0.618034 % 1, 0.65, 1.0)
    return round(255 * red), round(255 * green), round(255 * blue)
