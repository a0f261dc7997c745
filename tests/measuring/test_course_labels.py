"""How a training goes, episode by episode, without knowing what comes; and how it went."""

import json
from itertools import groupby

import numpy as np
import pytest
from places import GOLDEN, RESULTS
from told_courses import SIXTEEN_WORLDS

from cprl.measuring.live_label import Course
from cprl.measuring.outcome import Outcome, outcome_of
from cprl.measuring.series import Recent
from cprl.measuring.table import complete, where
from cprl.runs.curves import as_curves
from cprl.runs.episodes import read_episodes, read_rows

RANDOM = 282.0
TRAGEDY = np.repeat([312, 413, 492, 534, 587, 629, 618, 572, 418, 373, 270], 10)
"""Apples of four DQN agents who explore for sixty episodes; issue 17."""
HELD = json.loads((GOLDEN / "outcomes.json").read_text())
"""The labels of the mean over replicas of each stored run, and how each replica went."""


def labels(values, *, random_play=RANDOM):
    """The labels of a course, one after the other, each with the number of episodes that it lasts."""
    course = Course()
    course.random_play = random_play
    return [(label, len(list(same))) for label, same in groupby(map(course.add, values))]


def test_a_tragedy_is_seen_from_its_numbers_before_it_is_over():
    expected = [("begins", 9), ("steady", 4), ("rising", 56), ("steady", 14), ("falling", 27)]
    assert labels(TRAGEDY) == expected
    assert labels([*TRAGEDY, *[189] * 20])[-1] == ("below random play", 18)
    course = Course()
    for apples in TRAGEDY:
        course.add(apples)
    assert course.peak == pytest.approx(629.0, rel=0.01)
    assert course.mean == pytest.approx(np.mean(TRAGEDY[-11:]))


@pytest.mark.parametrize(
    ("levels", "random_play", "expected"),
    [
        ((300, 600, 350), RANDOM, "begins steady rising falling"),
        # A quarter of the loss regained is a recovery, which is over above the peak, or a fall again.
        ((600, 300, 450, 700, 700), RANDOM, "begins steady falling recovering rising"),
        ((600, 300, 500, 300), RANDOM, "begins steady falling recovering falling"),
        # Without random play the first running mean stands for it; the same fall is a third of a larger lead.
        ((300, 600, 420), None, "begins steady rising falling"),
        ((300, 600, 420), -1000.0, "begins steady rising steady"),
        ((-150, -190), -153.0, "begins steady below random play"),
        ((0, 0), 0.0, "begins steady"),
    ],
)
def test_a_course_is_judged_by_what_it_gains_loses_and_regains(levels, random_play, expected):
    course = labels(np.repeat(levels, 20), random_play=random_play)
    assert " ".join(label for label, _ in course) == expected


def test_with_many_worlds_the_tragedy_is_seen_in_as_many_episodes_as_with_one():
    course, seen = Course(worlds=16), []
    course.random_play = 280.0
    for group, apples in enumerate(SIXTEEN_WORLDS, 1):
        for world in range(16):
            label = course.add(apples, world=world)
        seen.append((16 * group, label))
        assert course.mean == pytest.approx(apples, rel=0.1)
    first = {label: episode for episode, label in reversed(seen)}
    assert set(first) == {"steady", "rising", "falling", "below random play"}
    assert first["steady"] == 16, "sixteen episodes are evidence enough"
    assert first["rising"] < first["falling"] < first["below random play"] < 170
    assert dict(seen)[96] == "rising", "where the agents get most"
    assert all(label == "below random play" for episode, label in seen if episode >= 170)


def test_every_world_counts_alike_though_some_end_their_episodes_sooner():
    course = Course(worlds=2)
    for world in [0, 1] * 5 + [0] * 9 + [1]:
        course.add(100.0 if world else 10.0, world=world)
    assert course.mean == 55.0, "the last five of each of the two"
    assert course.label == "steady"


def test_nothing_is_judged_before_each_world_has_ended_its_part():
    course = Course(worlds=2)
    assert {course.add(10.0, world=0) for _ in range(20)} == {"begins"}


def test_replicas_are_judged_by_the_episodes_that_all_of_them_have_ended():
    course = Course(replicas=2)
    for _ in range(20):
        course.add(10.0, replica=0, world=0)
    assert np.isnan(course.mean)
    assert course.label == "begins"
    for apples in range(12):
        course.add(float(apples), replica=1, world=1)
    assert course.mean == np.mean([10.0, *[np.mean(range(2, 12))]])


def test_agents_below_random_play_are_dead_once_all_their_boards_die_until_some_live():
    course, seen = Course(), []
    course.random_play = 100.0
    died = [*[False] * 15, *[True] * 20, *[False] * 3, *[True] * 3]
    for apples, has_died in zip([50.0] * len(died), died, strict=True):
        seen.append(course.add(apples, has_died=has_died))
    # In the 25th episode ten boards have died, in the 36th nine of ten, in the 37th eight.
    assert [(label, len(list(same))) for label, same in groupby(seen)] == [
        ("begins", 9),
        ("below random play", 15),
        ("dead", 12),
        ("below random play", 5),
    ]
    without_stock = Course()
    without_stock.random_play = 100.0
    assert [without_stock.add(50.0) for _ in range(40)][-1] == "below random play"


def test_boards_that_die_while_agents_get_more_than_random_play_do_not_make_them_dead():
    course = Course()
    course.random_play = 100.0
    assert [course.add(200.0, has_died=True) for _ in range(40)][-1] == "steady"


def test_a_mean_counts_episodes_whatever_the_number_that_each_value_is_of():
    assert [Recent(10, each=worlds).window for worlds in (1, 3, 4, 10, 16, 256)] == [10, 4, 3, 1, 1, 1]


def test_noise_around_random_play_is_neither_rise_nor_fall():
    noise = RANDOM + np.random.default_rng(0).normal(0, 20, 500)
    assert labels(noise) == [("begins", 9), ("steady", 491)]


@pytest.mark.parametrize(
    ("peak", "last", "expected"),
    [(-120, -120, "no better"), (-40, -45, "harvesting"), (-40, -99, "decline"), (-40, -106, "tragedy")],
)
def test_negative_incomes_are_better_above_random_play_and_worse_below_it(peak, last, expected):
    outcome = Outcome(
        first_mean=-100,
        peak=peak,
        peak_episode=10,
        lowest_after_peak=last,
        last_mean=last,
        life_share=0.5,
        random_mean=-100.0,
        agents=4,
    )
    assert outcome.word == expected


@pytest.mark.parametrize("run", [pytest.param(name, marks=pytest.mark.integration) for name in HELD])
def test_stored_runs_go_and_went_as_they_did(run):
    random = as_curves(read_rows(RESULTS / run / "evaluation" / "random.parquet"))
    level = float(random["collective_return"].mean())
    table = complete(read_episodes(RESULTS / run))
    names = ("collective_return", "terminated")
    course, labels_of, endings = Course(len(HELD[run]["endings"])), [], []
    course.random_play = level
    for replica in range(len(HELD[run]["endings"])):
        rows = where(table, replica=replica)
        endings.append(outcome_of(rows, random=level).word)
        ended = where(rows, agent=0)
        for apples, has_died in zip(*(ended[name].to_pylist() for name in names), strict=True):
            labels_of.append(course.add(apples, replica=replica, has_died=has_died))
    assert endings == HELD[run]["endings"]
    assert [label for label, _ in groupby(labels_of)] == HELD[run]["labels"]


@pytest.mark.parametrize(
    ("epsilons", "expected"),
    [
        ([1.0, 1.0, 0.6, 0.3, 0.1, 0.1, 0.1], [True, True, True, True, True, False, False]),
        ([0.05, 0.05, 0.05], [None, False, False]),
        ([0.3, 0.2, 0.2], [None, True, False]),
        ([None, None], [None, None]),
    ],
)
def test_agents_explore_while_an_epsilon_falls_or_is_high(epsilons, expected):
    course, seen = Course(), []
    for epsilon in epsilons:
        seen.append(
            course.note_epsilons({} if epsilon is None else {"agent_0": epsilon, "agent_1": float("nan")})
        )
    assert seen == expected


def test_the_recent_mean_is_of_the_last_values_that_are_defined():
    recent = Recent(3)
    assert [recent.add(value) for value in (0.0, 1.0, 5.0, 3.0)] == [0, 0.5, 2, 3]
    assert recent.add(float("nan")) == 4
    assert np.isnan(Recent(3).add(float("nan")))
