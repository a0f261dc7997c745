"""Rules and presets: every field is checked, and quirks, windows and learners match the study."""

from dataclasses import fields, replace

import numpy as np
import pytest

from cprl import Rules, presets

WRONG = {
    "regrow_prob": [(), (0.5, 1.5), (float("nan"),), (1e-10,)],
    "regrow_radius_cells": [-1, float("inf")],
    "beam_length_cells": [0, (1, 2, 3), (1, 2, 3, 0)],
    "beam_width_cells": [0, 2],
    "hits_to_tag": [0],
    "freeze_steps": [-1],
    "window_rows": [0, 2**31 - 1],
    "window_columns": [0, 12],
    "episode_steps": [0],
}


@pytest.mark.parametrize(("name", "value"), [(name, value) for name in WRONG for value in WRONG[name]])
def test_a_number_out_of_range_is_refused(name, value):
    with pytest.raises(ValueError, match=rf"Rules\.{name} is .*; allowed: "):
        Rules(**{name: value})


def test_lists_and_arrays_become_tuples_so_that_rules_compare_and_hash():
    given = Rules(regrow_prob=[0, 0.5], beam_length_cells=np.array([1, 2, 3, 4]), may_fire=np.bool_(False))
    same = Rules(regrow_prob=(0, 0.5), beam_length_cells=(1, 2, 3, 4), may_fire=False)
    assert given == same
    assert hash(given) == hash(same)


def test_every_quirk_is_off_as_published_and_on_as_run():
    switches = {field.name for field in fields(Rules) if field.default is False}
    quirks = switches - {"walls_block_sight", "shuffle_starts", "agent_1_right_moves_agent_0"}
    assert len(quirks) == 8
    for board in presets.BOARDS:
        published = presets.game(board).rules
        as_run = presets.game(board, variant="as_run").rules
        assert not any(getattr(published, quirk) for quirk in quirks)
        assert all(getattr(as_run, quirk) for quirk in quirks)


@pytest.mark.parametrize(
    ("board", "published", "as_run"),
    [("single_basic", (6, 13), (5, 13)), ("two_complex", (6, 13), (5, 13)), ("commons", (7, 15), (7, 15))],
)
def test_windows_have_the_published_sizes(board, published, as_run):
    assert presets.game(board).observation_shape == (3, *published)
    assert presets.game(board, variant="as_run").observation_shape == (3, *as_run)


def test_without_a_beam_there_are_seven_actions_and_six_is_stay():
    assert presets.game("single_basic").actions[6] == "stay"
    assert len(presets.game("single_basic").actions) == 7
    assert presets.game("commons").actions[6:] == ("beam", "stay")


@pytest.mark.parametrize(("board", "variant"), [("pond", "published"), ("commons", "as_writen")])
def test_an_unknown_preset_is_refused_with_what_is_allowed(board, variant):
    with pytest.raises(ValueError, match="allowed: "):
        presets.game(board, variant=variant)
    with pytest.raises(ValueError, match="allowed: "):
        presets.dqn_settings(board, variant=variant)


def test_learners_differ_between_boards_and_variants_only_where_the_study_says():
    assert presets.dqn_settings("commons").epsilon_decay_steps == 1_000_000
    assert presets.dqn_settings("two_complex").epsilon_decay_steps == 500_000
    as_run = presets.dqn_settings("single_basic", variant="as_run")
    assert as_run.relu_on_outputs
    assert as_run.glorot_uniform
    assert as_run.own_target_weights
    assert as_run.mean_over_all_outputs
    assert as_run.adam_eps == 1e-7
    written = replace(
        as_run,
        relu_on_outputs=False,
        glorot_uniform=False,
        own_target_weights=False,
        mean_over_all_outputs=False,
        adam_eps=1e-8,
    )
    assert written == presets.dqn_settings("single_basic")


def test_epsilon_is_constant_then_falls_linearly_then_is_constant():
    settings = presets.dqn_settings("single_basic")
    assert [settings.epsilon(step) for step in (0, 800)] == [1.0, 1.0]
    assert settings.epsilon(800 + 250_000) == pytest.approx(0.55)
    assert [settings.epsilon(step) for step in (500_800, 10**7)] == pytest.approx([0.1, 0.1])
