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


HELD = [1.0] * 20 + [0.6, 0.3, 0.1] + [0.1] * 10
NOISE = RANDOM + np.random.default_rng(0).normal(0, 20, 500)
COURSES = {
    "while epsilon falls no loss is a tragedy": (
        (np.repeat(TRAGEDY, 10), falling(110, 200)),
        [("exploring", 110)],
    ),
    "an epsilon of one is exploration": (([5.0] * 33, HELD), [("exploring", 23), ("harvesting", 10)]),
    "a small constant epsilon is none": (([5.0] * 12, [0.05] * 12), [("begins", 9), ("harvesting", 3)]),
    "noise around random play is no tragedy": ((NOISE,), [("begins", 9), ("harvesting", 491)]),
}


@pytest.mark.parametrize("case", COURSES)
def test_a_course_has_its_labels_each_for_so_many_episodes(case):
    course, expected = COURSES[case]
    assert labels(Now(agents=4, random_play=RANDOM), *course) == expected


@pytest.mark.parametrize(
    ("levels", "changes", "expected"),
    [
        ((300, 600, 250), {}, "begins harvesting tragedy"),
        # A quarter of the loss regained is a recovery, which is over above the peak, or a tragedy again.
        ((600, 300, 450, 700, 700), {}, "begins harvesting tragedy recovery harvesting"),
        ((600, 300, 500, 300), {}, "begins harvesting tragedy recovery tragedy"),
        ((600, 300), {"agents": 1}, "begins harvesting decline"),  # one alone shares nothing
        # Without random play the first running mean stands for it; the same fall is a third of a larger lead.
        ((300, 600, 420), {"random_play": None}, "begins harvesting tragedy"),
        ((300, 600, 420), {"random_play": -1000.0}, "begins harvesting"),
    ],
)
def test_learners_without_epsilon_are_judged_by_what_they_lose_and_regain(levels, changes, expected):
    now = Now(**{"agents": 4, "random_play": RANDOM, **changes})
    assert [label for label, _ in labels(now, np.repeat(levels, 20))] == expected.split()


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
