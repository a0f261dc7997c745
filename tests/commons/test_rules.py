"""Rules, presets and chance: each field is checked, quirks match the study, numbers are those of Philox."""

from dataclasses import fields

import numba
import numpy as np
import pytest

from cprl import Quirks2019, Rules, presets
from cprl.commons.chance import philox4x32
from cprl.institutions.institution import threshold

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
    assert [getattr(Quirks2019(), field.name) for field in fields(Quirks2019)] == [True] * 6
    for board in presets.BOARDS:
        published = presets.game(board).rules
        as_run = presets.game(board, variant="as_run").rules
        assert (published.clashes, published.growth, published.quirks) == ("all_back", "from_start", None)
        assert (as_run.clashes, as_run.growth, as_run.quirks) == ("pairwise", "before_bites", Quirks2019())


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


@pytest.mark.parametrize(
    ("board", "variant", "field"),
    [
        ("pond", "published", "(name|board) is 'pond'"),
        ("commons", "as_writen", "variant"),
        ("ssd/harvest-v1", "as_run", "(board|variant) is "),
        ("two_complex", "as_run_10_april", "variant"),
    ],
)
def test_an_unknown_preset_is_refused_with_what_is_allowed(board, variant, field):
    for preset in (presets.game, presets.dqn_settings, presets.gymnasium_env):
        with pytest.raises(ValueError, match=rf"{field}.*allowed: "):
            preset(board, variant=variant)


def test_epsilon_is_constant_then_falls_linearly_then_is_constant():
    settings = presets.dqn_settings("single_basic")
    assert [settings.epsilon(step) for step in (0, 800)] == [1.0, 1.0]
    assert settings.epsilon(800 + 250_000) == pytest.approx(0.55)
    assert [settings.epsilon(step) for step in (500_800, 10**7)] == pytest.approx([0.1, 0.1])


KNOWN_ANSWERS = [  # from the vectors published with Random123, philox4x32, 10 rounds
    ("00000000 00000000 00000000 00000000", "00000000 00000000", "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
    ("ffffffff ffffffff ffffffff ffffffff", "ffffffff ffffffff", "408f276d 41c83b0e a20bc7c6 6d5451fd"),
    ("243f6a88 85a308d3 13198a2e 03707344", "a4093822 299f31d0", "d16cfe09 94fdcceb 5001e420 24126ea1"),
]


def words(text):
    return [np.uint64(int(word, 16)) for word in text.split()]


@pytest.mark.parametrize(("counter", "key", "answer"), KNOWN_ANSWERS)
def test_philox_gives_the_known_answers_compiled_or_not(counter, key, answer):
    for philox in (philox4x32, numba.njit(philox4x32)):
        assert list(philox(*words(counter), *words(key))) == words(answer)


def test_a_threshold_is_the_probability_of_a_word_below_it():
    assert threshold(0.0) == 0
    assert threshold(1.0) == 2**32
    assert threshold(0.01) / 2**32 == pytest.approx(0.01, abs=2**-33)
