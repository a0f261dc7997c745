"""Agents as they are drawn: number, heading and second mark, each inside its cell."""

import numpy as np
import pytest

from cprl import Game, Rules, maps
from cprl.commons.batch import Batch
from cprl.commons.picture import BODY, INK, MARKED, agent_sprite, number_pixels, world_image
from cprl.viewer.stage import marks, numbers, numbers_and_headings


def test_digits_are_drawn_on_three_by_five_pixels():
    drawn = ["".join(".#"[int(pixel)] for pixel in row) for row in number_pixels(42)]
    assert drawn == ["#.#.###", "#.#...#", "###.###", "..#.#..", "..#.###"]
    assert len({number_pixels(digit).tobytes() for digit in range(10)}) == 10


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


def test_marks_are_drawn_from_agent_4_on():
    parts = [set(agent_sprite(agent, 0, 23).ravel().tolist()) for agent in (3, 4, 8, 12)]
    assert [MARKED in part for part in parts] == [False, True, True, True]
    assert all({BODY, INK} <= part for part in parts)


def test_a_picture_draws_each_agent_in_its_own_cell_alone():
    batch = Batch(Game(map=maps.parse("A>.\nA.v"), rules=Rules()), 1)
    now = batch.show(batch.begin(batch.new_output()))
    nobody = now._replace(in_play=np.zeros(2, np.bool_))
    empty, drawn = (world_image(batch.game.map, world, cell_pixels=12) for world in (nobody, now))
    differs = (empty != drawn).any(-1)
    for cell in ((slice(1, 12), slice(13, 24)), (slice(13, 24), slice(25, 36))):
        assert differs[cell].mean() > 0.6
        differs[cell] = False
    assert not differs.any()


def test_all_lines_of_agents_stay_in_their_cells():
    for strokes in (numbers_and_headings(120), numbers(120), marks(120)):
        assert np.abs(strokes.shape).max() <= 0.5
    assert set(marks(12).owner) == set(range(4, 12))


def test_an_agent_that_is_not_drawn_has_no_lines():
    centres = np.array([[(1.5, 2.5), (4.5, 2.5)]] * 2, np.float32)
    heading, drawn = np.array([[1, 0]] * 2), np.array([[True, True], [False, True]])
    lines, counts = numbers_and_headings(2).placed(centres, heading, drawn)
    assert counts.tolist() == [4, 2]
    assert (np.abs(lines[4:] - (4.5, 2.5)) < 0.5).all(), "the second frame has agent 1 alone"
