"""The live label follows a course of apples, episode by episode, without knowing what comes."""

from itertools import groupby
from pathlib import Path

import numpy as np
import pytest

from cprl.measuring.now import Now
from cprl.measuring.series import Recent
from cprl.runs.curves import curves_of

RANDOM = 282.0
TRAGEDY = [312, 413, 492, 534, 587, 629, 618, 572, 418, 373, 270]
"""Apples per ten episodes of four DQN agents who explore for sixty; issue 17."""
RESULTS = Path(__file__).parents[1] / "docs" / "results"


def labels(now, values, epsilons=None):
    """The labels of a course, one after the other, each with the number of episodes that it lasts."""
    told = (
        now.add(value, None if epsilons is None else {"agent_0": epsilon})
        for value, epsilon in zip(values, values if epsilons is None else epsilons, strict=True)
    )
    return [(label, len(list(own))) for label, own in groupby(told)]


def falling(episodes, over):
    """Epsilon at the end of each episode: from 1 to 0.1 over so many, then constant."""
    return np.maximum(0.1, 1 - 0.9 * np.arange(1, episodes + 1) / over)


def test_four_dqn_agents_explore_harvest_and_end_in_a_tragedy():
    now = Now(agents=4, random_play=RANDOM)
    course = np.repeat(TRAGEDY, 10)
    assert labels(now, course, falling(110, 60)) == [("exploring", 60), ("harvesting", 23), ("tragedy", 27)]
    assert now.explored == 61, "the first episode after exploration"
    assert now.peak == pytest.approx(629.0, rel=0.01)
    assert now.mean == pytest.approx(np.mean(course[-11:]))


def test_while_epsilon_falls_no_loss_is_a_tragedy():
    course = np.repeat(TRAGEDY, 10)
    assert labels(Now(agents=4, random_play=RANDOM), course, falling(110, 200)) == [("exploring", 110)]


def test_an_epsilon_of_one_is_exploration_before_it_begins_to_fall():
    held = [1.0] * 20 + [0.6, 0.3, 0.1] + [0.1] * 10
    told = labels(Now(agents=4), [5.0] * 33, held)
    assert told == [("exploring", 23), ("harvesting", 10)]


def test_a_small_constant_epsilon_is_no_exploration():
    assert labels(Now(agents=4), [5.0] * 12, [0.05] * 12) == [("begins", 9), ("harvesting", 3)]


def test_learners_without_epsilon_are_judged_from_the_tenth_episode_on():
    course = [*[300] * 20, *[600] * 20, *[250] * 30]
    told = labels(Now(agents=4, random_play=RANDOM), course)
    assert [label for label, _ in told] == ["begins", "harvesting", "tragedy"]
    assert told[0] == ("begins", 9)


def test_who_regains_a_quarter_of_the_loss_recovers_and_above_the_peak_it_is_over():
    course = [*[600] * 20, *[300] * 20, *[450] * 20, *[700] * 40]
    told = labels(Now(agents=4, random_play=RANDOM), course)
    assert [label for label, _ in told] == ["begins", "harvesting", "tragedy", "recovery", "harvesting"]


def test_a_recovery_that_is_lost_again_is_a_tragedy_again():
    course = [*[600] * 20, *[300] * 20, *[500] * 20, *[300] * 20]
    told = labels(Now(agents=4, random_play=RANDOM), course)
    assert [label for label, _ in told][-2:] == ["recovery", "tragedy"]


def test_a_single_agent_shares_nothing_and_declines():
    course = [*[600] * 20, *[300] * 20]
    assert labels(Now(agents=1, random_play=RANDOM), course)[-1][0] == "decline"


def test_noise_around_random_play_is_no_tragedy():
    course = RANDOM + np.random.default_rng(0).normal(0, 20, 500)
    told = labels(Now(agents=4, random_play=RANDOM), course)
    assert {label for label, _ in told} == {"begins", "harvesting"}


def test_without_random_play_the_first_running_mean_stands_for_it():
    course = [*[300] * 10, *[600] * 20, *[420] * 20]
    assert labels(Now(agents=4), course)[-1][0] == "tragedy"
    assert labels(Now(agents=4, random_play=-1000.0), course)[-1][0] == "harvesting", (
        "a third of another lead"
    )


def test_a_published_length_run_is_told_as_exploration_tragedy_and_recovery():
    means = curves_of(RESULTS / "commons_targets_10")["collective_return"].mean(0)
    told = labels(Now(agents=4, random_play=RANDOM), means, falling(len(means), 400))
    assert [label for label, _ in told] == ["exploring", "harvesting", "tragedy", "recovery"]


def test_a_label_goes_on_from_its_state():
    course, epsilons = np.repeat(TRAGEDY, 10), falling(110, 60)
    whole, first = Now(agents=4, random_play=RANDOM), Now(agents=4, random_play=RANDOM)
    told = [whole.add(value, {"a": epsilon}) for value, epsilon in zip(course, epsilons, strict=True)]
    for value, epsilon in zip(course[:77], epsilons[:77], strict=True):
        first.add(value, {"a": epsilon})
    second = Now(agents=4, random_play=RANDOM)
    second.load_state_dict(first.state_dict())
    rest = [second.add(own, {"a": epsilon}) for own, epsilon in zip(course[77:], epsilons[77:], strict=True)]
    assert rest == told[77:]
    assert second.state_dict() == whole.state_dict()


def test_the_recent_mean_is_of_a_share_of_the_values_so_far_but_of_some_at_least():
    recent = Recent(3, share=0.5)
    assert [recent.add(value) for value in range(10)] == [0, 0.5, 1, 2, 3, 4, 4.5, 5.5, 6, 7]
    assert recent.window == 5
    assert np.isnan(Recent(3).add(float("nan")))
