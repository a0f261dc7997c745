"""Games of the literature: their traces, rules of their own, and the table of random play in the docs."""

from dataclasses import replace

import gymnasium
import numpy as np
import pettingzoo
import pytest
from boards import Play, assert_same, play_on, random_actions
from hypothesis import given, settings, strategies as st
from places import DATA
from random_games import (
    check_apples,
    check_no_beam_passes_a_wall,
    check_places,
    check_worlds_are_independent,
    games as plain_games,
)

from cprl import Observation, RandomEnd, River, Rules, maps, presets
from cprl.commons.batch import Batch
from cprl.commons.literature import LITERATURE_GAMES
from cprl.commons.near import growth_probs
from cprl.institutions import Punishment
from cprl.values import from_config, to_config

TRACES = sorted((DATA / "traces" / "games").glob("*.npz"))
GAMES = {
    "ssd_harvest": "ssd/harvest-v1",
    "ssd_cleanup": "ssd/cleanup-v1",
    "socialjax_harvest": "socialjax/harvest_open-v1",
    "melting_pot_open": "melting_pot/commons_harvest__open-v1",
    "melting_pot_closed": "melting_pot/commons_harvest__closed-v1",
}


@pytest.mark.parametrize("path", TRACES, ids=lambda path: path.stem)
def test_a_game_plays_the_trace_of_its_original(path):
    """Growth is certain, or there is none; agents that were in each other's way are put where they went."""
    trace = np.load(path)
    name, _, growth = path.stem.rpartition("_")
    game = presets.game(GAMES[name])
    probs = (0.0, 1.0) if growth == "growth" else (0.0,)
    certain = {"regrow_prob": probs}
    if game.rules.river is not None:
        certain["river"] = replace(game.rules.river, pollution_prob=0.0)
        if growth == "none":
            certain["regrow_prob"] = (2**-32,)  # an empty board that stays empty is refused
    game = replace(game, rules=replace(game.rules, **certain))
    batch = Batch(game, 1)
    output = batch.begin()
    sites = tuple(np.array(game.map.sites).T)

    hidden = trace["hidden"] if "hidden" in trace else np.zeros_like(trace["apples"])

    def put(turn, agents=slice(None)):
        """Puts agents where they are in the trace."""
        state = batch.state()
        for entry in ("row", "col", "heading"):
            state[entry][0, agents] = trace[entry][turn, agents]
        batch.load(state, output)

    put(0)
    for turn, actions in enumerate(trace["actions"]):
        before = batch.state()
        played = batch.play(actions[None].astype(np.int64), output)
        reward = played.reward[0].copy()
        tagged = played.tagged_by[0].copy()
        state = batch.state()
        returned = state["in_play"][0] & ~before["in_play"][0]
        if game.rules.respawn_at_spawns:
            returned |= tagged.any(1) & state["in_play"][0]
        if trace["is_contested"][turn]:
            returned = state["in_play"][0]
        put(turn + 1, returned)
        state, in_play = batch.state(), batch.state()["in_play"][0]
        if not trace["is_contested"][turn]:
            for entry in ("row", "col", "heading"):
                assert state[entry][0, in_play].tolist() == trace[entry][turn + 1, in_play].tolist(), turn
            assert reward.tolist() == trace["reward"][turn].tolist(), turn
            if "tagged_by" in trace:
                assert tagged.tolist() == trace["tagged_by"][turn].tolist(), turn
        if game.map.river:
            river = tuple(np.array(game.map.river).T)
            assert state["waste"][0].tolist() == trace["waste"][turn + 1][river].tolist(), turn
        shown = ~hidden[turn + 1][sites]
        assert state["stock"][0][shown].tolist() == trace["apples"][turn + 1][sites][shown].tolist(), turn
    assert trace["is_contested"].mean() < 0.25


@st.composite
def games(draw):
    """Small crowded boards with spawn places, under any of the rules of the literature."""
    game = draw(plain_games(beam_width_cells=3))
    board, rules = game.map, game.rules
    taken = {*board.sites, *board.walls, *((row, col) for row, col, _ in board.starts)}
    cells = [(r, c) for r in range(board.height) for c in range(board.width) if (r, c) not in taken]
    begun = [(row, col) for row, col, _ in board.starts]
    spawns = tuple(cells + begun[: draw(st.integers(0, len(begun)))])
    switches = ("regrow_under_agents", "beam_tapers", "beam_from_beside", "beam_stops_at_agents")
    switches += ("plays_on_when_empty", "random_headings", "harvest_action", "shuffle_starts")
    changes = {name: draw(st.booleans()) for name in switches}
    rules = replace(
        rules,
        **changes,
        growth=draw(st.sampled_from(["after_bites", "before_bites", "from_start"])),
        regrow_prob=draw(st.sampled_from([(0.1, 0.4), (0.0, 0.3, 0.9)])),
        regrow_by=draw(st.sampled_from(["count", "share", "share_with_own"])),
        first_stock_share=draw(st.sampled_from([1.0, 0.5])) if len(board.sites) > 1 else 1.0,
        cooldown_steps=draw(st.integers(0, 3)),
        respawn_at_spawns=bool(spawns) and draw(st.booleans()),
        clashes=draw(st.sampled_from(["all_back", "one_moves", "in_turn"])),
        random_end=draw(st.sampled_from([None, RandomEnd(prob=0.1)])),
    )
    return replace(game, map=replace(board, spawns=spawns), rules=rules)


@pytest.mark.integration
@pytest.mark.filterwarnings("ignore:no agent can harvest:UserWarning")
@settings(max_examples=80, deadline=None)
@given(games(), st.integers(0, 2**32))
def test_the_invariants_hold_under_the_rules_of_the_literature(game, seed):
    check_places(game, seed)
    check_apples(game, seed)
    check_no_beam_passes_a_wall(game, seed)


@pytest.mark.filterwarnings("ignore:no agent can harvest:UserWarning")
@settings(max_examples=20, deadline=None)
@given(games(), st.integers(0, 2**32))
def test_a_state_under_these_rules_determines_the_future(game, seed):
    batch, actions = Batch(game, 3, seed=seed), random_actions(30, 3, game, seed=seed)
    output = batch.begin()
    play_on(batch, output, actions[:10])
    other = Batch(game, 3)
    again, rest = other.load(batch.state()), actions[10:]
    for one, two in zip(play_on(batch, output, rest), play_on(other, again, rest), strict=True):
        assert_same(one, two)


@pytest.mark.parametrize("name", LITERATURE_GAMES)
def test_a_game_of_the_literature_is_made_everywhere_by_its_id(name):
    game = presets.game(name)
    assert presets.game(name) == game
    assert name in presets.names()
    assert from_config(to_config(game)) == game
    parallel = pettingzoo.make("parallel", name)
    parallel.reset(seed=1)
    assert len(parallel.agents) == game.agents
    alone = gymnasium.make(name).unwrapped
    assert alone.game.agents == 1
    assert alone.game.rules == game.rules
    check_worlds_are_independent(game, 3)


# One rule at a time


def test_no_apple_grows_under_an_agent():
    play = Play(">AA", regrow_prob=(1.0,), regrow_under_agents=False).turn("forward")
    assert (play.harvest, play.output.regrown[0, 0]) == ([1], 0)
    play.turn("stay")
    assert (play.harvest, play.output.stock[0, 0]) == ([0], 1)
    play.turn("forward")  # onto the other site, so that the first one is free
    assert (play.board, play.output.stock[0, 0]) == (".A>", 1)


def test_growth_counts_the_stock_after_the_bites():
    one = Play(">A.A<", regrow_prob=(0.0, 1.0), growth="after_bites").turn("forward", "stay")
    assert one.output.regrown[0, 0] == 1  # the apple that is left makes the bitten one grow in the same turn
    assert Play(">A.A<", regrow_prob=(0.0, 1.0)).turn("forward", "stay").output.regrown[0, 0] == 0


@pytest.mark.parametrize(
    ("by", "rows"),
    [
        ("count", [[0.0, 0.2, 0.6]]),
        ("share", [[0.0, 0.6, 0.6], [0.0, 0.2, 0.6]]),  # of one site near it, of two
        ("share_with_own", [[0.0, 0.2, 0.6], [0.0, 0.4 / 3, 0.2 + 0.4 / 3]]),
    ],
)
def test_growth_by_count_and_by_share(by, rows):
    rules = Rules(regrow_prob=(0.0, 0.2, 0.6), regrow_by=by)
    of_site, probs = growth_probs(rules, np.array([1, 2, 1]))
    assert np.allclose(probs, rows)
    assert of_site.tolist() == ([0] if by == "count" else [0, 1, 0])


def test_sites_grow_as_often_as_the_share_of_full_sites_near_them_says():
    """The corner has two sites near it, one with an apple; the middle one has four, one with an apple."""
    rules = {"regrow_prob": (0.0, 0.8), "regrow_by": "share", "regrow_radius_cells": 1}
    play = Play("AAA.\nAAA.\nAAA>", worlds=4000, **rules)
    grown = play.put(stock=np.tile(np.eye(9, dtype=np.uint8)[1], (4000, 1))).turn("stay").batch.now.stock
    assert grown.mean(0)[[0, 4]] == pytest.approx([0.4, 0.2], abs=0.03)
    assert not grown[:, [3, 8]].any()


def test_an_episode_begins_with_a_share_of_the_apples_drawn_anew_each_time():
    play = Play(maps.published("commons"), worlds=2000, first_stock_share=0.25)
    first = play.batch.state()["stock"]
    assert (first.sum(1) == round(len(play.game.map.sites) / 4)).all()
    assert np.abs(first.mean(0) - 0.25).max() < 0.06
    assert (first != play.again().batch.now.stock).any(1).all()


def test_harvest_is_an_action_of_its_own():
    play = Play(">AA", harvest_action=True).turn("forward")
    assert play.game.actions[-2:] == ("stay", "harvest")
    assert (play.harvest, play.turn("stay").harvest, play.turn("harvest").harvest) == ([0], [0], [1])
    assert Play(">AA", harvest_action=True, may_fire=False).game.actions[-2:] == ("stay", "harvest")


def test_beams_taper_begin_beside_the_agent_and_stop_at_agents():
    """Four agents look up; only the last one fires. In its column two stand one behind the other."""
    board = ".^..A\n.....\n.^...\n^....\n.^..."
    hits = {}
    for name in ("", "beam_tapers", "beam_from_beside", "beam_stops_at_agents"):
        rules = {name: True} if name else {}
        play = Play(board, beam_length_cells=4, **rules).turn("stay", "stay", "stay", "beam")
        hits[name] = play.output.hit_by[0, :, 3].tolist()
    assert hits[""] == [True, True, True, False]
    assert hits["beam_stops_at_agents"] == [False, True, True, False]
    beside = Play("A.A\n^^.", beam_from_beside=True).turn("stay", "beam")
    assert beside.output.hit_by[0, 0].tolist() == [False, True]
    assert not Play("A.A\n^^.").turn("stay", "beam").output.hit_by.any()
    short = Play("^..\n...\n.^A", beam_length_cells=2, beam_tapers=True).turn("stay", "beam")
    assert not short.output.hit_by.any()
    assert Play("^..\n...\n.^A", beam_length_cells=2).turn("stay", "beam").output.hit_by.any()


def test_an_agent_cannot_fire_again_before_it_has_cooled_down():
    play = Play("A>", cooldown_steps=2)
    assert [bool(play.turn("beam").output.fired[0, 0]) for _ in range(7)] == [True, False, False] * 2 + [True]


def test_agents_begin_at_spawn_places_and_return_to_them():
    board = maps.parse("PPPPP\n.....\nA>A..", agents=4)
    assert (board.agents, board.starts[1:]) == (4, ((0, 0, maps.UP), (0, 1, maps.UP), (0, 2, maps.UP)))
    play = Play(board, worlds=600, random_headings=True, respawn_at_spawns=True, freeze_steps=1)
    state = play.batch.state()
    assert (state["row"] == [2, 0, 0, 0]).all()
    assert (state["col"][:, 0] == 1).all()
    assert all(len({*row}) == 3 for row in state["col"][:, 1:].tolist())
    places, headings = (np.bincount(state[name][:, 1:].reshape(-1)) for name in ("col", "heading"))
    assert np.abs(places / 1800 - 1 / 5).max() < 0.04
    assert np.abs(headings / 1800 - 1 / 4).max() < 0.04
    state["row"][:, 0], state["heading"][:, 0] = 1, 0
    state["col"][:, 0] = state["col"][:, 1]  # right below agent 1
    assert play.put(**state).turn("beam", "stay", "stay", "stay").output.tagged_by[:, 1, 0].all()
    after = play.turn("stay").batch.now
    assert after.in_play.all()
    free = {*range(5)} - {*state["col"][0, 1:].tolist()} | {int(state["col"][0, 1])}
    assert int(after.col[0, 1]) in free
    assert len({*after.col[:, 1].tolist()}) > 1


def test_of_two_agents_that_want_a_cell_one_gets_it_by_lot():
    gets = {}
    for clashes in ("all_back", "one_moves", "in_turn"):
        play = Play(">A<\nA..", worlds=2000, clashes=clashes).turn("forward")
        gets[clashes] = play.output.harvest.mean(0)
    assert gets["all_back"].tolist() == [0, 0]
    for clashes in ("one_moves", "in_turn"):
        assert gets[clashes].sum() == 1
        assert abs(gets[clashes][0] - 0.5) < 0.05


@pytest.mark.parametrize(("clashes", "share", "tolerance"), [("one_moves", 1, 0), ("in_turn", 0.5, 0.05)])
def test_whoever_follows_another_agent_moves_always_or_if_it_comes_later(clashes, share, tolerance):
    play = Play(">>.A", worlds=2000, clashes=clashes).turn("forward")
    assert (play.batch.now.col[:, 0] == 1).mean() == pytest.approx(share, abs=tolerance)


def test_an_episode_ends_by_chance_and_is_truncated():
    by_chance = RandomEnd(prob=0.25, from_step=5, every_steps=3)
    board = maps.published("single_basic")
    play = Play(board, worlds=3000, random_end=by_chance, plays_on_when_empty=True)
    lengths, is_over = np.zeros(3000), np.zeros(3000, np.bool_)
    while not is_over.all():
        lengths += ~is_over
        is_over |= play.turn("turn_left").output.truncated[:, 0]
    assert {*lengths % 3} == {2}
    assert lengths.min() == 5
    assert lengths.mean() == pytest.approx(5 + 3 * 3, abs=0.8)


def test_an_empty_board_ends_an_episode_or_not():
    for plays_on in (False, True):
        play = Play(">A", plays_on_when_empty=plays_on).turn("forward")
        assert play.output.terminated[0, 0] != plays_on


def test_a_fine_costs_the_one_who_fines():
    punishment = Punishment(fine=2, cost=1, shot_cost=0.5)
    play = Play(">.>A\n>.>A", institutions=(punishment,), freeze_steps=0, beam_width_cells=1)
    assert play.turn("beam", "stay", "stay", "stay").reward == [-1.5, -2, 0, 0]
    assert play.in_play == [True] * 4
    assert play.turn("stay", "forward", "stay", "beam").reward == [0, 1, 0, -0.5]


@pytest.mark.parametrize(
    ("rules", "named"),
    [
        ({"first_stock_share": 1.5}, "first_stock_share"),
        ({"first_stock_share": 0.1}, "first_stock_share"),  # no apple, and none can grow
        ({"respawn_at_spawns": True}, "respawn_at_spawns"),
        ({"river": River()}, "river"),  # the board has none
    ],
)
def test_rules_that_do_not_go_together_are_refused(rules, named):
    with pytest.raises(ValueError, match=rf"Rules\.{named} is "):
        Play(">A", **rules)


# The river


def river(**rules):
    """Two agents before a river of four cells, two of which have waste; apples grow unless there is waste."""
    board = "v..A\n~H~.\nH..v"
    rules = {"regrow_prob": (1.0,), "river": River(may_clean=True, pollution_limit=0.75), **rules}
    return Play(board, first_stock_share=0.0, beam_width_cells=1, **rules)


def test_cleaning_removes_the_first_waste_ahead_and_apples_grow_the_less_waste_there_is():
    play = river()
    assert play.game.actions[-1] == "clean"
    assert (play.game.map.waste, play.output.waste[0].tolist()) == ((1, 3), [2])
    play.turn("turn_left", "stay")
    play.turn("clean", "stay")
    assert (play.output.cleaned[0].tolist(), play.output.waste[0, 0]) == ([0, 0], 2)
    play.turn("turn_right", "stay").turn("clean", "stay")
    assert (play.output.cleaned[0].tolist(), play.output.waste[0, 0]) == ([1, 0], 1)


def test_apples_grow_by_the_share_of_clean_water():
    grown = {}
    for limit in (0.5, 1.0):
        waste = River(may_clean=True, pollution_limit=limit)
        play = river(worlds=4000, regrow_prob=(0.8,), river=waste).turn("stay")
        grown[limit] = play.output.regrown.mean()
    assert grown[0.5] == 0
    assert grown[1.0] == pytest.approx(0.8 * 0.5, abs=0.03)


def test_waste_comes_to_one_clean_cell_a_turn_up_to_the_limit():
    polluted = River(pollution_prob=0.5, pollution_limit=0.75)
    play = Play(">A..\n~~~~", worlds=4000, regrow_prob=(0.5,), river=polluted).turn("stay")
    waste = play.batch.state()["waste"]
    assert waste.sum(1).max() == 1
    assert waste.sum(1).mean() == pytest.approx(1 - 0.5**4, abs=0.02)
    assert np.abs(waste.mean(0) - (1 - 0.5**4) / 4).max() < 0.03
    for _ in range(30):
        play.turn("stay")
    assert (play.output.waste == 3).all()


def test_agents_see_water_waste_and_the_cleaning_beam():
    play = river(window_rows=3, window_columns=5).turn("stay", "turn_left")
    assert {"~", "H"} <= {*play.window(0)}
    play.turn("clean", "stay")
    assert "c" in play.window(0)
    encoded = replace(play.game, observation=Observation(encoding="one_hot"))
    assert encoded.channels[-3:] == ("water", "waste", "cleaning")


def test_a_river_needs_a_map_with_one_and_shares_in_order():
    with pytest.raises(ValueError, match=r"Map\.river has 0 cells and Rules\.river is River"):
        Play(">A", river=River(may_clean=True))
    with pytest.raises(ValueError, match=r"Map\.river has 1 cell and Rules\.river is None"):
        Play(">A~")
    with pytest.raises(ValueError, match=r"River\.pollution_free"):
        River(pollution_free=0.5, pollution_limit=0.5)
    with pytest.raises(ValueError, match=r"Map\.waste"):
        replace(maps.parse(">A~"), waste=(1,))


# Maps


def test_drawings_of_others_are_read_by_their_own_legends(tmp_path):
    board = maps.parse("WWWW\nWA W\nWPQW\nWWWW", legend="melting_pot", agents=2)
    assert (board.sites, board.spawns) == (((1, 1),), ((2, 1),))
    assert board.starts == ((2, 2, maps.UP), (2, 1, maps.UP))
    path = tmp_path / "map.txt"
    path.write_text("@@@@\n@A @\n@PP@\n@@@@\n")
    board = maps.read_file(path, legend="ssd", agents=1)
    assert (board.agents, len(board.spawns), len(board.walls)) == (1, 2, 12)
    assert maps.parse("x.o>", legend={"x": "site", ".": "ground", "o": "wall", ">": "left"}).starts[0][2] == 3


@pytest.mark.parametrize(
    ("drawing", "arguments", "message"),
    [
        ("@@@\n@?@", {"legend": "ssd"}, "unknown sign '\\?' at row 1, column 1"),
        ("AP", {}, "agents"),
        ("AP>", {"agents": 3}, "agents is 3"),
        ("A>", {"legend": "dm"}, "legend"),
        ("A>", {"legend": {"A": "apple", ">": "up"}}, "legend\\['A'\\]"),
    ],
)
def test_a_drawing_that_cannot_be_read_is_refused_with_its_place(drawing, arguments, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        maps.parse(drawing, **arguments)
    path = tmp_path / "map.txt"
    path.write_text(drawing)
    with pytest.raises(ValueError, match=message):
        maps.read_file(path, **arguments)


def test_with_a_radius_that_spans_the_board_growth_is_logistic():
    """Each of the K - s empty sites grows with probability r s / K: r s (1 - s / K) apples on average."""
    rate, sites, rng = 0.4, 24, np.random.default_rng(0)
    probs = tuple(rate * s / sites for s in range(sites + 1))
    board = "\n".join([">.......", *["AAAAAAAA"] * 3])
    play = Play(board, worlds=4096, regrow_prob=probs, regrow_radius_cells=1000)
    for stock in (6, 12, 18):
        full = (rng.random((4096, sites)).argsort(1) < stock).astype(np.uint8)
        grown = play.put(stock=full).turn("stay").output.regrown.mean()
        assert abs(grown - rate * stock * (1 - stock / sites)) < 0.1
