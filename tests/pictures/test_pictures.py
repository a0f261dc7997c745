"""Pictures for people: colours differ for those who lack a cone, agents are told apart, each in its cell."""

from itertools import combinations

import numpy as np
import pytest

from cprl import Game, Rules, maps
from cprl.commons.batch import Batch
from cprl.commons.cells import APPLE, BEAM, FIRST_AGENT, GROUND, SELF, WALL, class_colour
from cprl.pictures.colours import agent_colour, agent_mark, picture_colour
from cprl.pictures.image import INK, agent_sprite, world_image
from cprl.viewer.board import glyphs, mark, number, number_and_heading

SEEN = {
    "deuteranopia": (
        [(0.367322, 0.860646, -0.227968), (0.280085, 0.672501, 0.047413), (-0.011820, 0.042940, 0.968881)],
        18.9,
    ),
    "protanopia": (
        [(0.152286, 1.052583, -0.204868), (0.114503, 0.786281, 0.099216), (-0.003882, -0.048116, 1.051998)],
        20.6,
    ),
}
"""Matrices of linear RGB at full severity and the smallest difference found. From Machado, Oliveira and
Fernandes, "A physiologically-based model for simulation of color vision deficiency", IEEE TVCG 15, 2009."""
TO_XYZ = np.array(
    [(0.4124564, 0.3575761, 0.1804375), (0.2126729, 0.7151522, 0.0721750), (0.0193339, 0.1191920, 0.9503041)]
)
"""sRGB with white D65, IEC 61966-2-1."""
COLOURS = {
    **{name: picture_colour(kind) for name, kind in (("apple", APPLE), ("beam", BEAM), ("wall", WALL))},
    "ground": picture_colour(GROUND),
    **{f"agent {agent}": agent_colour(agent) for agent in range(4)},
}


def lab(linear):
    """CIE 1976 L*a*b* of linear RGB."""
    share = linear @ TO_XYZ.T / TO_XYZ.sum(1)
    x, y, z = np.where(share > (6 / 29) ** 3, np.cbrt(share), share * (29 / 6) ** 2 / 3 + 4 / 29)
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


def differences(matrix, colours=COLOURS):
    """The CIE 1976 colour difference (Delta E*ab) of each pair of colours as seen through the matrix."""
    places = {}
    for name, colour in colours.items():
        part = np.array(colour) / 255
        linear = np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)
        places[name] = lab(np.clip(np.array(matrix) @ linear, 0, 1))
    return {
        pair: float(np.linalg.norm(places[pair[0]] - places[pair[1]])) for pair in combinations(colours, 2)
    }


@pytest.mark.parametrize("kind", SEEN)
def test_all_colours_of_pictures_differ_for_people_who_lack_a_cone(kind):
    matrix, least = SEEN[kind]
    nearest, found = min(differences(matrix).items(), key=lambda pair: pair[1])
    assert found >= least, f"{nearest} differ by {found:.1f} under {kind}"


def test_twelve_agents_differ_from_each_other_in_hue_or_mark():
    assert len({(agent_colour(agent), agent_mark(agent)) for agent in range(12)}) == 12
    assert agent_colour(4) == agent_colour(0), "no fifth hue is far enough from the others"
    assert [agent_mark(agent) for agent in (0, 4, 8)] == ["plain", "ring", "stripe"]


def test_windows_keep_the_colours_of_the_study():
    assert class_colour(SELF) == (0, 0, 255)
    assert class_colour(APPLE) == (0, 255, 0)
    assert class_colour(FIRST_AGENT) == (86, 156, 255), "stored agents learned from these under agents_apart"


@pytest.mark.parametrize("size", [11, 15, 23, 35])
def test_forty_eight_agents_look_different_whatever_their_heading(size):
    for heading in range(4):
        assert len({agent_sprite(agent, heading, size).tobytes() for agent in range(48)}) == 48


@pytest.mark.parametrize("agent", [0, 5, 10, 13])
def test_the_heading_is_where_the_triangle_is(agent):
    for heading in range(4):
        ink = agent_sprite(agent, heading, 23) == INK
        up = np.rot90(ink, heading)
        rows = [row.sum() for row in up if row.any()]
        assert rows[:3] == [1, 3, 5], "it points in the direction of the heading"


def test_a_picture_draws_each_agent_in_its_own_cell_alone():
    batch = Batch(Game(map=maps.parse("A>.\nA.v"), rules=Rules()), 1)
    now = batch.show(batch.begin())
    nobody = now._replace(in_play=np.zeros(2, np.bool_))
    empty, drawn = (world_image(batch.game.map, world, cell_pixels=12) for world in (nobody, now))
    differs = (empty != drawn).any(-1)
    for cell in ((slice(1, 12), slice(13, 24)), (slice(13, 24), slice(25, 36))):
        assert differs[cell].mean() > 0.6
        differs[cell] = False
    assert not differs.any()


def test_all_lines_of_agents_stay_in_their_cells():
    for lines_of in (number_and_heading, number, mark):
        assert np.abs(glyphs(120, lines_of).corners).max() <= 0.5
    assert set(glyphs(12, mark).agent_of_line) == set(range(4, 12))


def test_the_measure_finds_colours_that_look_the_same():
    old = {"agent 0": (86, 156, 255), "agent 3": (186, 110, 255)}
    assert differences(SEEN["deuteranopia"][0], old)["agent 0", "agent 3"] < 3
