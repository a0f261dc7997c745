"""The palette of all pictures for people: in the viewer, and in images, figures and films.

Apples, agents, beams, walls and ground can also be told apart by people with deuteranopia or protanopia. Only
four hues for agents are so different. So agents 4 to 7 have the hues of agents 0 to 3 again, with a mark. The
windows that agents observe use other colours, see `cprl.commons.cells`.
"""

from typing import Final

from cprl.commons.cells import (
    APPLE,
    BEAM,
    CLASS_COLOURS,
    CLEANING,
    FIRST_AGENT,
    GROUND,
    WALL,
    WASTE,
    WATER,
    Colour,
)

ORANGE = (230, 160, 0)
BLUE = (86, 180, 233)
GREEN = (0, 158, 115)
VERMILION = (213, 94, 0)
PURPLE = (204, 121, 167)
GREY = (150, 150, 150)
"""The colours of lines and states: those of M. Okabe and K. Ito, which the colour-blind can tell apart, and a
grey."""

PALETTE: Final[dict[int, Colour]] = {
    GROUND: (16, 18, 22),
    WALL: (70, 74, 84),
    APPLE: (31, 163, 90),
    BEAM: (200, 200, 200),
    WATER: (28, 52, 84),
    WASTE: (124, 88, 40),
    CLEANING: (150, 220, 220),
}
"""The colour of each class of cells in pictures for people; `agent_colour` has those of agents."""

AGENT_COLOURS: Final[tuple[Colour, ...]] = (BLUE, (230, 97, 0), (240, 228, 66), PURPLE)
"""The hues of agents: blue, orange, yellow, pink."""

MARKS: Final = ("plain", "ring", "stripe", "corners")
"""The marks of agents: none for agents 0 to 3, a ring for 4 to 7, a stripe for 8 to 11, and the four
corners for 12 to 15. They repeat from agent 16 on, and there only the number tells agents apart."""


def agent_colour(agent: int) -> Colour:
    """Return an agent's hue; agents 0 and 4 have the same one, since there are only four."""
    return AGENT_COLOURS[agent % len(AGENT_COLOURS)]


def line_colour(agent: int) -> Colour:
    """Return an agent's colour in plots over time, which have no marks.

    This is the agent's hue, lighter for agents 4 to 7 and darker for agents 8 to 11.
    """
    black_or_white, hue_share = _LINE_TINTS[agent // len(AGENT_COLOURS) % len(_LINE_TINTS)]
    red, green, blue = (
        round(black_or_white + hue_share * (component - black_or_white)) for component in agent_colour(agent)
    )
    return red, green, blue


_LINE_TINTS: Final = ((0, 1.0), (255, 0.4), (0, 0.5))
"""For agents 0 to 3, 4 to 7 and 8 to 11: the grey that is mixed into their hues, and the share of the hue."""


def agent_mark(agent: int) -> str:
    """Return an agent's mark, one of `MARKS`; hue and mark together tell sixteen agents apart."""
    return MARKS[agent // len(AGENT_COLOURS) % len(MARKS)]


def picture_colour(kind: int) -> Colour:
    """Return the colour of a class of cells in pictures for people.

    Classes that only occur in windows keep the colour that they have there.
    """
    if kind < FIRST_AGENT:
        return PALETTE.get(kind, CLASS_COLOURS[kind])
    return agent_colour(kind - FIRST_AGENT)
