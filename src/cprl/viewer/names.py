"""The names of what a recording holds, and the colours that several parts of it share."""

from collections.abc import Mapping
from typing import Final

from cprl.commons.cells import Colour
from cprl.measuring import outcome
from cprl.pictures.colours import BLUE, GREEN, GREY, ORANGE, VERMILION
from cprl.pictures.decoding import UNSEEN

HEADER: Final = "header"
"""The entity of the text that people read first."""
NOW: Final = "now"
EXPLORING: Final = "exploring"
"""The entities of states: the live label, and whether agents explore."""
JOINT: Final = "joint_actions"
"""The lines of the shares of joint actions, in small matrix games."""
RANDOM_PLAY: Final = "random_play"
"""The folder of the lines of random play; each has the name of its metric."""
EVALUATION: Final = "evaluation"
"""The folder of the lines of evaluations while agents are trained, likewise."""
PAID, GIVEN = "paid", "given"
"""The lines of each agent in a replay: what institutions take in a turn, downwards, and give, upwards."""

EMPTY_SITE: Final = UNSEEN - 1
"""The class of a site without an apple on boards."""
TEXT: Final = (200, 200, 200)
BACKGROUND: Final = (24, 26, 32)
"""The background of boards and windows, which sets their dark cells apart from the viewer's own colour."""
DIED: Final = VERMILION
"""The colour of a board that died."""
SETTLED: Final = "settled"
"""The state of agents who explore no more, which is not drawn."""
STATES: Final[Mapping[str, Colour]] = {
    outcome.BEGINS: (80, 80, 80),
    outcome.RISING: GREEN,
    outcome.RECOVERING: BLUE,
    outcome.STEADY: GREY,
    outcome.FALLING: ORANGE,
    outcome.BELOW: VERMILION,
    outcome.DEAD: (140, 40, 0),
    outcome.EXPLORING: (60, 90, 130),
    SETTLED: BACKGROUND,
}
"""The colours of live labels, and of agents who explore."""
