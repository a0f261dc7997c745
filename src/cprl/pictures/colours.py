"""The palette of pictures for people: the viewer's, boards, figures and films.

Apples, agents, beams, walls and ground also differ under deuteranopia and protanopia. Only four hues are that
far apart: agents 4 to 7 have those of agents 0 to 3, and a mark. The windows that agents observe have other
colours, see `cprl.commons.cells`.
"""

from typing import Final

from cprl.commons.cells import APPLE, BEAM, CLEANING, COLOURS, FIRST_AGENT, GROUND, WALL, WASTE, WATER, Colour

ORANGE = (230, 160, 0)
BLUE = (86, 180, 233)
GREEN = (0, 158, 115)
VERMILION = (213, 94, 0)
PURPLE = (204, 121, 167)
GREY = (150, 150, 150)
"""The colours of lines and states: M. Okabe and K. Ito's, apart for the colour-blind too, and a grey."""

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


def agent_colour(agent: int) -> Colour:
    """Return an agent's hue in pictures for people; agents 0 and 4 have the same."""
    return AGENT_COLOURS[agent % len(AGENT_COLOURS)]


def line_colour(agent: int) -> Colour:
    """Return an agent's colour in plots over time, where no mark can stand: the hue, lighter for agents 4 to
    7 and darker for 8 to 11."""
    tints = ((0, 1.0), (255, 0.4), (0, 0.5))
    towards, share = tints[agent // len(AGENT_COLOURS) % len(tints)]
    red, green, blue = (round(towards + share * (part - towards)) for part in agent_colour(agent))
    return red, green, blue


def agent_mark(agent: int) -> str:
    """Return an agent's second mark, one of `MARKS`; with the hue it tells sixteen agents apart."""
    return MARKS[agent // len(AGENT_COLOURS) % len(MARKS)]


def picture_colour(kind: int) -> Colour:
    """Return the colour of a class in pictures for people; those that only windows have keep the study's."""
    if kind < FIRST_AGENT:
        return PALETTE.get(kind, COLOURS[kind])
    return agent_colour(kind - FIRST_AGENT)
