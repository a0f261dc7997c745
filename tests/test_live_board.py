"""The exhibited board: what viewers get of each frame, in one row."""

import numpy as np

from cprl import maps
from cprl.commons.colours import APPLE, BEAM, FIRST_AGENT, GROUND, MARK, WALL, agent_colour
from cprl.viewer.exhibition import LiveBoard
from cprl.viewer.scenery import Scene

BOARD = maps.parse(".A>\n.A<")


def scene():
    return Scene(agents=("agent_0", "agent_1"), height=2, width=3, walls=(), sites=BOARD.sites, window=(3, 3))


def frames(*in_play):
    """Frames of the two agents in the right column, each with whether they are in play; a beam on top."""
    count = len(in_play)
    beams = np.zeros((count, 2, 3), np.bool_)
    beams[:, 0] = True
    return {
        "step": np.zeros(count, np.int64),
        "beams": beams,
        "stock": np.ones((count, 2), np.uint8),
        "row": np.tile(np.array([0, 1], np.int32), (count, 1)),
        "col": np.full((count, 2), 2, np.int32),
        "heading": np.zeros((count, 2), np.int32),
        "in_play": np.array(in_play, np.bool_),
    }


def rows(name, seen):
    made = {kind.component: own for kind, own in LiveBoard(scene()).columns(seen).items()}
    return made[name].to_pylist()


def test_a_beam_changes_the_class_of_ground_and_apples_and_agents_stay_before_it():
    ((picture,),) = rows("SegmentationImage:buffer", frames((True, True)))
    assert np.array(picture).reshape(4, 5).tolist() == [
        [WALL] * 5,
        [WALL, BEAM, MARK, FIRST_AGENT, WALL],
        [WALL, GROUND, APPLE, FIRST_AGENT + 1, WALL],
        [WALL] * 5,
    ]


def test_an_agent_out_of_play_has_a_square_and_its_number_in_its_own_colour():
    seen = frames((True, True), (True, False))
    both, one = rows("LineStrips2D:strips", seen)
    red, green, blue = agent_colour(1)
    of_out = red << 24 | green << 16 | blue << 8 | 255
    colours = rows("LineStrips2D:colors", seen)
    assert of_out not in colours[0]
    assert colours[1].count(of_out) == 2, "a square and the digit 1"
    square = np.array(one[colours[1].index(of_out)])
    # Agent 1 is on row 1, column 2; with the rim its middle is (3.5, 2.5), and the square reaches 0.4.
    assert np.allclose([square.min(0), square.max(0)], [(3.1, 2.1), (3.9, 2.9)])
    assert [len(own) for own in rows("LineStrips2D:radii", seen)] == [len(both), len(one)]
