"""Where agents go, when they fire, who keeps to which cells: on boards small enough to count by hand, and of
stored runs in fresh worlds beside random play."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from matplotlib.image import imread
from measures import distance_to_nearest, nearness, rounds_of
from stored_runs import CORRIDORS, SEED

import cprl
from cprl import CommonsEnv, Fresh, Game, Rules, keys, maps
from cprl.evaluation.populations import agents_of, fresh_for, fresh_worlds, policies_of, scripted_agent
from cprl.experimental import movement
from cprl.experimental.territory import TERRITORY_NUMBERS, draw_visits, maps_of, number_of, territory_of
from cprl.measuring.playing import evaluate
from cprl.measuring.table import where

FORWARD, BEAM, STAY = 0, 6, 7


def drawn(cells, *, fired=(), in_play=None, board=(3, 4)):
    """A trace of one world: `cells` [T][N] of (row, col), `fired` (step, agent) pairs."""
    places = np.array(cells)[:, None]
    shape = places.shape[:-1]
    shots = np.zeros(shape, bool)
    for step, agent in fired:
        shots[step, 0, agent] = True
    here = np.ones(shape, bool) if in_play is None else np.array(in_play, bool)[:, None]
    return movement.Trace(
        row=places[..., 0],
        col=places[..., 1],
        in_play=here,
        fired=shots,
        played=np.ones(shape[:2], bool),
        board=board,
    )


def test_a_trace_has_the_cells_of_all_agents_at_the_start_of_each_step_and_every_tag_with_who_fired():
    game = Game(
        map=maps.parse("A...A\n>...<\n....."),
        rules=Rules(regrow_prob=(0.0,), episode_steps=4, window_rows=3, window_columns=5, freeze_steps=9),
    )
    plan = iter([(FORWARD, STAY), (BEAM, FORWARD), (STAY, STAY), (STAY, STAY)])
    played = movement.trace(
        CommonsEnv(game), lambda moment: moment.set(keys.ACTION, torch.tensor([next(plan)]))
    )
    assert played.row[:, 0].tolist() == [[1, 1]] * 4
    assert played.col[:, 0, 0].tolist() == [0, 1, 1, 1]
    assert played.fired[:, 0].tolist() == [[False, False], [True, False], [False, False], [False, False]]
    assert played.in_play[:, 0, 1].tolist() == [True, True, False, False], "hit in the second step"
    assert played.played.all()
    assert played.board == (3, 5)
    assert played.tags.tolist() == [[1, 0, 1, 0]], "agent 1 in step 1, by agent 0"
    assert movement.taggings(played)[0].tolist() == [[0, 0], [1, 0]]
    where = np.argwhere(movement.tagged_where(played))
    assert where.tolist() == [[0, 1, 1, 4]], "world 0, agent 1, at the cell from which it walked"


def test_a_trace_marks_the_steps_of_worlds_that_have_ended_as_not_played():
    game = Game(map=maps.parse("A>.\n..."), rules=Rules(regrow_prob=(0.0,), episode_steps=3))
    actions = torch.tensor([[1], [7 - 1]])  # backward onto the only apple; stay
    found = movement.trace(CommonsEnv(game, 2), lambda moment: moment.set(keys.ACTION, actions))
    assert found.played.sum(0).tolist() == [1, 3]


def test_visits_are_shares_of_the_steps_in_play():
    cells = [[(0, 0), (2, 3)], [(0, 1), (2, 3)], [(0, 1), (2, 3)], [(0, 1), (0, 0)]]
    in_play = [[1, 1], [1, 1], [1, 0], [1, 1]]
    shares = movement.visit_shares(drawn(cells, in_play=in_play))[0]
    assert shares[0, 0, :2].tolist() == [0.25, 0.75]
    assert shares[1, 2, 3] == pytest.approx(2 / 3)
    assert shares.sum((-2, -1)).tolist() == pytest.approx([1.0, 1.0])


def test_overlap_is_one_for_the_same_cells_and_zero_for_different_ones():
    assert movement.overlap(drawn([[(0, 0), (0, 1)], [(0, 1), (0, 0)]])).tolist() == [1.0]
    assert movement.overlap(drawn([[(0, 0), (2, 3)], [(0, 1), (2, 2)]])).tolist() == [0.0]
    # (0, 0): 1/2 and 1/2; only one agent visits (0, 1), only the other (0, 2).
    assert movement.overlap(drawn([[(0, 0), (0, 0)], [(0, 1), (0, 2)]])).tolist() == [0.5]
    assert np.isnan(movement.overlap(drawn([[(0, 0)], [(0, 1)]]))).all()


def test_rounds_count_signed_turns_about_the_centre():
    clockwise = [(0, 1), (0, 2), (1, 3), (2, 2), (2, 1), (1, 0)]
    there = [[cell] for cell in [*clockwise * 5, clockwise[0]]]
    assert rounds_of(drawn(there))[0, 0] == pytest.approx(5 / 30 * 1000)
    assert rounds_of(drawn(there[::-1]))[0, 0] == pytest.approx(-5 / 30 * 1000)
    to_and_fro = [[cell] for cell in (clockwise + clockwise[::-1]) * 4]
    assert rounds_of(drawn(to_and_fro))[0, 0] == pytest.approx(0.0)


def test_nearness_compares_steps_with_a_shot_to_all_steps():
    cells = [[(0, 0), (0, 1), (2, 3)], [(0, 0), (0, 3), (2, 3)]]
    in_play = [[1, 1, 1], [1, 0, 1]]
    drawing = drawn(cells, fired=[(0, 0), (1, 2)], in_play=in_play)
    nearest = distance_to_nearest(drawing)[:, 0]
    assert nearest[0].tolist() == [1.0, 1.0, 4.0]
    assert nearest[1, [0, 2]].tolist() == [5.0, 5.0]
    assert np.isinf(nearest[1, 1])
    fired, always = (1.0 + 5.0) / 2, (1 + 1 + 4 + 5 + 5) / 5
    assert nearness(drawing, range(3), lambda means: means).tolist() == [fired / always]
    assert np.isnan(nearness(drawn(cells), range(3), lambda means: means)).all(), "no agent fired"


APART = [[[0.5, 0.5, 0, 0]], [[0, 0, 1.0, 0]]]
"""Two agents on a board of one row and four columns, each in cells of its own."""
ALIKE = [[[0.5, 0.5, 0, 0]]] * 2
HALF = [[[0.5, 0.5, 0, 0]], [[0, 0.5, 0.5, 0]]]
"""They share the second cell: of the four halves of their time, two are spent where nobody else comes."""


def shot(tags, cells, **more):
    """A trace with these tags: (step, world, tagged, by) each."""
    return replace(drawn(cells, **more), tags=np.array(tags, np.int64).reshape(-1, 4))


NOBODY = [[0, 0, 0, 0]]


@pytest.mark.parametrize(
    ("shares", "excluded", "sharing"),
    [
        (APART, 1, 1),
        (ALIKE, 0, 2),
        # In half of their time the cell says who it is, in the other half it is either: H = 1/2 log 2.
        (HALF, 0.5, 2**0.5),
        # p = (3/4, 1/4) and q = (1/4, 3/4), their mean (1/2, 1/2), of which the divergence is
        # 3/4 log(3/2) + 1/4 log(1/2) = log 2 - H(1/4) = (1 - 0.811278) log 2.
        ([[[0.75, 0.25]], [[0.25, 0.75]]], 1 - 0.811278, 2**0.811278),
        # Of three agents two share all cells: H(agent | cell) = 2/3 log 2, of log 3.
        ([[[1.0, 0]], [[1.0, 0]], [[0, 1.0]]], 1 - 2 / 3 * np.log(2) / np.log(3), 2 ** (2 / 3)),
        # An agent that was never in play does not count.
        ([*APART, NOBODY], 1, 1),
        ([*HALF, NOBODY], 0.5, 2**0.5),
        (APART[:1], np.nan, 1),
        ([NOBODY, NOBODY], np.nan, np.nan),
        # Each of two worlds.
        ([APART, HALF], [1, 0.5], [1, 2**0.5]),
    ],
)
def test_agents_exclude_each_other_as_far_as_a_cell_says_who_they_are(shares, excluded, sharing):
    np.testing.assert_allclose(movement.exclusion(shares), excluded, atol=1e-6)
    np.testing.assert_allclose(movement.agents_per_cell(shares), sharing, atol=1e-6)


def test_the_owner_of_a_cell_spends_the_largest_share_there():
    assert movement.owners([[[0.75, 0.25, 0]], [[0.25, 0.75, 0]]]).tolist() == [[0, 1, -1]]
    assert movement.owners(ALIKE).tolist() == [[0, 0, -1, -1]], "of equal ones the first"


def test_two_beams_at_once_count_for_both_who_fired_and_once_for_the_tagged():
    played = shot([(0, 0, 2, 0), (0, 0, 2, 1), (1, 0, 0, 1)], [[(0, 0), (0, 3), (2, 2)]] * 2)
    assert movement.taggings(played)[0].tolist() == [[0, 1, 0], [0, 0, 0], [1, 1, 0]]
    assert movement.tagged_where(played).sum((0, 2, 3)).tolist() == [1, 0, 1]
    assert movement.tagged_where(played)[0, 2, 2, 2] == 1


def test_to_defend_is_to_tag_whom_one_finds_in_ones_own_cells():
    # Agent 1 comes into (0, 0) in the last of four steps, where agent 0 was in three of its four.
    cells = [[(0, 0), (2, 3)], [(0, 0), (2, 3)], [(0, 0), (2, 3)], [(0, 1), (0, 0)]]
    at_home = shot([(3, 0, 1, 0)], cells)
    assert movement.defence(at_home, movement.visit_shares(at_home)).tolist() == [1.0]
    intruding = shot([(3, 0, 1, 0), (0, 0, 1, 0)], cells)
    assert movement.defence(intruding, movement.visit_shares(intruding)).tolist() == [0.5], (
        "the second one at (2, 3), the other's"
    )
    nowhere = np.zeros((2, 3, 4))
    assert movement.defence(at_home, nowhere).tolist() == [0.5], "neither is at home"
    assert np.isnan(movement.defence(shot([], cells), nowhere)).all()


def test_agents_in_corridors_of_their_own_exclude_each_other(corridors):
    table = territory_of(corridors["greedy"], Fresh(episodes=4))
    found = cprl.estimates(table, list(TERRITORY_NUMBERS), "policy").of("trained")
    assert found["exclusion"].value == found["visitors"].value == 1
    assert found["overlap"].value == found["tag_rate"].value == 0
    assert not found["defence"].replicas, "nobody can fire"
    # Agent 0 starts at (0, 0) and bites at columns 1 and 3 in steps 1 and 3; the cell of step t is that at
    # its start. Agent 1 starts at (2, 4) and walks left. After step 3 the board is dead.
    visits = maps_of(table, "visits").reshape(2, 2, 3, 5)
    np.testing.assert_allclose(visits[0, 0, 0], [1 / 3, 1 / 3, 1 / 3, 0, 0])
    np.testing.assert_allclose(visits[1, 1, 2], [0, 0, 1 / 3, 1 / 3, 1 / 3])


def test_the_episodes_are_those_of_an_evaluation(alike):
    run = cprl.load(alike)
    fresh = fresh_for([run], Fresh(episodes=5, seed=SEED))
    table = territory_of(run, fresh)
    played = {"trained": agents_of(run), "random": [scripted_agent("random")] * 2}
    for policy, agents in played.items():
        ((group, env),) = fresh_worlds(fresh, run)
        ended = evaluate(env, policies_of(fresh, run, agents, group), explore=True)
        taggings = maps_of(table, "tags_by_agent", policy)
        for place in range(len(group)):
            episodes = ended[5 * place : 5 * place + 5]
            tagged_by = sum(own.tagged_by for own in episodes)
            assert taggings[place].tolist() == tagged_by.tolist()
            tagged = sum(own.tagged for own in episodes)
            assert maps_of(table, "tags_by_cell", policy)[place].sum(1).tolist() == tagged.tolist()
            per_1000 = 1000 * tagged_by.sum() / sum(own.steps for own in episodes)
            assert number_of(table, "tag_rate", policy)[place] == pytest.approx(per_1000)
    assert maps_of(table, "tags_by_agent", "random").sum() > 0


def test_a_replica_alone_stays_where_it_stays_among_all(alike):
    both, alone = (territory_of(alike, Fresh(episodes=3, replicas=replicas)) for replicas in ((), (2,)))
    among_all = where(both, replica=2).to_pydict()
    for name, values in alone.to_pydict().items():
        np.testing.assert_array_equal(values, among_all[name], name)


def test_the_maps_show_where_each_agent_was_and_are_not_written_over(corridors, tmp_path):
    found = territory_of(corridors["greedy"], Fresh(episodes=2))
    path = draw_visits(found, CORRIDORS.map, tmp_path / "new" / "visits.png", replica=1)
    picture = (imread(path)[..., :3] * 255).round()
    for agent, colour in ((0, (86, 180, 233)), (1, (230, 97, 0))):
        assert (np.abs(picture - colour).max(-1) < 2).sum() > 1000, f"agent {agent} in its hue"
    with pytest.raises(FileExistsError, match=r"visits\.png exists and is not overwritten"):
        draw_visits(found, CORRIDORS.map, path)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"replica": 2}, "replica is 2"),
        ({"policy": "greedy"}, "policy is 'greedy'"),
        ({"path": "visits.gif"}, "path is '.*visits.gif'"),
    ],
)
def test_what_cannot_be_drawn_is_refused(more, message, corridors, tmp_path):
    found = territory_of(corridors["greedy"], Fresh(episodes=1))
    with pytest.raises(ValueError, match=message):
        draw_visits(found, CORRIDORS.map, **{"path": tmp_path / "visits.png", **more})
    assert not list(tmp_path.iterdir())
