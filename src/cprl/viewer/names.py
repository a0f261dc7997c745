"""The names of the entities in a recording, and the colours that several of its parts share."""

from typing import Final

from cprl.measuring import live_label
from cprl.pictures.colours import BLUE, GREEN, GREY, ORANGE, VERMILION
from cprl.pictures.decoding import UNSEEN

HEADER: Final = "header"
"""The entity of the header: one line of text above all plots."""
LABEL_STRIP: Final = "now"
"""The entity of the live label, a strip that says how the group does, such as "rising"."""
EXPLORATION_STRIP: Final = "exploring"
"""The entity of the strip that says whether agents explore."""
JOINT: Final = "joint_actions"
"""The entity of the shares of joint actions, in small matrix games."""
RANDOM_PLAY_FOLDER: Final = "random_play"
"""The folder of the lines of random play; each has the name of its metric."""
EVALUATION_FOLDER: Final = "evaluation"
"""The folder of the lines of evaluations while agents are trained; each has the name of its metric."""
PAID: Final = "paid"
"""The line of what institutions take from an agent in a turn of a replay, downwards."""
GIVEN: Final = "given"
"""The line of what institutions give an agent in a turn of a replay, upwards."""

EMPTY_SITE: Final = UNSEEN - 1
"""The class of a site without an apple on boards."""
TEXT: Final = (200, 200, 200)
"""The colour of texts on boards and plots."""
BOARD_BACKGROUND: Final = (24, 26, 32)
"""The background of boards and windows: their dark cells differ from the viewer's background."""
DIED: Final = VERMILION
"""The colour of a board that died: its last apple was taken before the time was up."""
SETTLED: Final = "settled"
"""The state of agents that no longer explore, which is not drawn."""
STATES: Final = {
    live_label.BEGINS: (80, 80, 80),
    live_label.RISING: GREEN,
    live_label.RECOVERING: BLUE,
    live_label.STEADY: GREY,
    live_label.FALLING: ORANGE,
    live_label.BELOW: VERMILION,
    live_label.DEAD: (140, 40, 0),
    live_label.EXPLORING: (60, 90, 130),
    SETTLED: BOARD_BACKGROUND,
}
"""The colours of the live labels, and of the strip that says whether agents explore."""
