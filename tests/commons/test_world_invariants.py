"""Invariants of every game, checked on random boards, rules and actions."""

import itertools
import pickle
from dataclasses import replace

import numpy as np
import pytest
from boards import assert_same, copied, only_quirks, play_on, played, random_actions
from hypothesis import given, settings, strategies as st
from random_games import (
    check_apples,
    check_no_beam_passes_a_wall,
    check_places,
    check_worlds_are_independent,
    games,
)

from cprl import CommonsEnv, Game, Rules, maps, presets
from cprl.commons import apples, beam, loops
from cprl.commons.batch import Batch
from cprl.institutions import sanctions
from cprl.system.jit import compiled, disk_cache

# Random walls and boundaries may part all agents from all apples.
pytestmark = pytest.mark.filterwarnings("ignore:no agent can harvest:UserWarning")

STAY = 7


def check_agent_indices_do_not_matter(game, seed, order):
    """The same agents under other indices play the same game."""
    renumbered = replace(game, map=replace(game.map, starts=tuple(game.map.starts[i] for i in order)))
    actions = random_actions(40, 2, game, seed=seed)
    once = played(game, actions, seed=seed)
    again = played(renumbered, actions[:, :, order].copy(), seed=seed)
    for (worlds, output, *_), (other_worlds, other_output, *_) in zip(once, again, strict=True):
        assert np.array_equal(worlds.stock, other_worlds.stock)
        for name in ("row", "col", "heading", "in_play", "out_steps", "hits"):
            assert np.array_equal(getattr(worlds, name)[:, order], getattr(other_worlds, name)), name
        for name in ("observation", "harvest", "fired"):
            assert np.array_equal(getattr(output, name)[:, order], getattr(other_output, name)), name
        assert np.array_equal(output.tagged_by[:, order][:, :, order], other_output.tagged_by)


def check_no_agent_out_of_play_acts(game, seed):
    """An agent out of play does not move, harvest or fire, and is not hit."""
    actions = random_actions(40, 3, game, seed=seed)
    moments = played(game, actions, seed=seed)
    for (before, *_), (after, output, *_) in itertools.pairwise(moments):
        out = ~before.in_play
        for name in ("row", "col", "heading"):
            assert np.array_equal(getattr(before, name)[out], getattr(after, name)[out]), name
        assert not output.harvest[out].any()
        assert not output.fired[out].any()
        assert not output.hit_by[out].any()
        assert not output.hit_by.transpose(0, 2, 1)[out].any()


SEEDS = st.integers(0, 2**32)
SOME = settings(max_examples=60, deadline=None)


@SOME
@given(games(), SEEDS)
def test_no_two_agents_in_play_share_a_cell_and_no_agent_stands_in_a_wall(game, seed):
    check_places(game, seed)


@pytest.mark.integration
@SOME
@given(games(), SEEDS, st.randoms(use_true_random=False))
def test_the_game_does_not_depend_on_agent_indices(game, seed, random):
    order = list(range(game.agents))
    random.shuffle(order)
    check_agent_indices_do_not_matter(game, seed, order)


@SOME
@given(games(), st.sampled_from(["from_start", "before_bites"]), SEEDS)
def test_apples_are_conserved_and_counted(game, growth, seed):
    check_apples(replace(game, rules=replace(game.rules, growth=growth)), seed)


@SOME
@given(games(freeze_steps=3), st.booleans(), SEEDS)
def test_no_agent_out_of_play_acts(game, as_run, seed):
    clashes = "pairwise" if as_run else "all_back"
    quirks = only_quirks(freeze_counts_tag_turn=True) if as_run else None
    rules = replace(game.rules, clashes=clashes, quirks=quirks)
    check_no_agent_out_of_play_acts(replace(game, rules=rules), seed)


@SOME
@given(games(beam_width_cells=3), SEEDS)
def test_no_beam_passes_a_wall(game, seed):
    check_no_beam_passes_a_wall(game, seed)


CROWDED = "A>#A.\n.v.<A\n#A.^#"
"""Walls between agents that often meet."""


@pytest.mark.parametrize("board", ["single", "multiple", "none", "unequal", "crowded"])
def test_the_invariants_hold_on_the_boards_with_walls(board):
    drawn = maps.parse(CROWDED) if board == "crowded" else maps.rooms(board)
    game = Game(map=drawn, rules=Rules(regrow_prob=(0, 0.1, 0.3), freeze_steps=4))
    check_places(game, 1)
    check_agent_indices_do_not_matter(game, 2, list(np.random.default_rng(0).permutation(game.agents)))
    check_apples(game, 3)
    check_no_agent_out_of_play_acts(game, 4)
    check_worlds_are_independent(game, 5)
    assert check_no_beam_passes_a_wall(game, 6) > (50 if board == "crowded" else 0)


@pytest.mark.parametrize(("board", "variant"), presets.GAMES)
def test_a_world_does_not_depend_on_other_worlds_or_the_number_of_threads(board, variant):
    game = presets.game(board, variant=variant)
    check_worlds_are_independent(game, 5)


def test_another_seed_world_or_episode_gives_another_game():
    game = presets.game("commons")
    actions = random_actions(150, 2, game)
    actions[:, 1] = actions[:, 0]

    def stocks(**options):
        return np.array([moment.turn.stock for moment in played(game, actions, **options)])

    base = stocks(seed=1)
    assert np.array_equal(base, stocks(seed=1))
    assert not np.array_equal(base, stocks(seed=2))
    assert not np.array_equal(base[:, 0], base[:, 1]), "two worlds of one seed"
    batch = Batch(game, 2, seed=1)
    output = batch.begin()
    batch.begin(output)
    second_episode = [batch.play(turn, output).stock.copy() for turn in actions]
    assert not np.array_equal(base[1:], second_episode)
    batch.set_seed(1)
    assert np.array_equal(batch.begin(output).stock, base[0])
    assert np.array_equal(batch.play(actions[0], output).stock, base[1])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"worlds": 0}, "worlds is 0"),
        ({"worlds": 2, "first_world": 2**32 - 1}, "first_world is 4294967295 and worlds is 2"),
        ({"worlds": 2, "first_world": 2**32}, "first_world is 4294967296"),
        ({"worlds": 2, "seed": -1}, "seed is -1"),
        ({"worlds": 2, "threads": 0}, "threads is 0"),
        ({"worlds": 2, "threads": 10**6}, "threads is 1000000"),
    ],
)
def test_a_batch_refuses_arguments_that_are_not_allowed(arguments, message):
    with pytest.raises(ValueError, match=message):
        Batch(presets.game("commons"), **arguments)


def test_a_cache_folder_that_is_not_writable_brings_a_warning(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.warns(RuntimeWarning, match=r"cannot be cached in .*; set CPRL_CACHE"):
        assert not disk_cache.can_write(blocked / "folder")


def test_only_a_changed_rule_changes_the_key_of_what_calls_it(monkeypatch):
    run, show, check = map(compiled.code_key, loops.ENTRIES)
    beside = compiled.code_key(beam.beam_begin)

    def keys():
        return list(map(compiled.code_key, loops.ENTRIES))

    def beam_begin(tables, side):
        """Another docstring."""
        # A comment.
        return 0 if tables.beam_from_beside and side != 0 else 1

    monkeypatch.setattr(beam.beam_begin, "__code__", beam_begin.__code__.replace(co_name="beam_begin"))
    assert compiled.code_key(beam.beam_begin) == beside
    assert keys() == [run, show, check]
    monkeypatch.setattr(beam.beam_begin, "__code__", (lambda tables, side: 2).__code__)
    assert keys()[0] != run
    assert keys()[1] != show
    assert keys()[2] == check
    monkeypatch.undo()
    assert keys() == [run, show, check]
    monkeypatch.setattr(sanctions, "SANCTIONS", 7)
    assert keys()[0] != run, "the same constant of another module is as before"
    monkeypatch.undo()
    monkeypatch.setattr(apples, "AFTER_BITES", 7)
    assert keys()[0] != run
    assert keys()[1] == show, "a board is drawn without a harvest"


@pytest.mark.skipif(compiled.runs_plain(), reason="all rules are plain Python")
@pytest.mark.parametrize("name", [*presets.BOARDS, "ssd/cleanup-v1"])
@pytest.mark.parametrize("variant", presets.VARIANTS)
def test_the_rules_play_the_same_game_as_plain_python(name, variant, monkeypatch):
    if name not in presets.BOARDS and variant != "published":
        pytest.skip("has no variant")
    game = presets.game(name, variant=variant)
    actions = random_actions(12, 2, game, seed=1)
    expected = played(game, actions, seed=1)
    monkeypatch.setenv(compiled.RULES_VARIABLE, compiled.PLAIN_RULES)
    for one, other in zip(played(game, actions, seed=1), expected, strict=True):
        assert_same(one, other)


def test_another_word_for_how_rules_run_is_refused(monkeypatch):
    monkeypatch.setenv(compiled.RULES_VARIABLE, "fast")
    with pytest.raises(ValueError, match=r'CPRL_RULES is .*fast.*"compiled" and "python"'):
        CommonsEnv(presets.game("commons"))


def test_a_pickled_batch_continues_like_the_original():
    game = presets.game("commons")
    batch = Batch(game, 2, seed=3)
    output = batch.begin()
    actions = random_actions(20, 2, game)
    play_on(batch, output, actions[:10])
    other, other_output = pickle.loads(pickle.dumps(batch)), copied(output)
    going_on = (play_on(each, out, actions[10:]) for each, out in ((batch, output), (other, other_output)))
    for one, two in zip(*going_on, strict=True):
        assert_same(one, two)
