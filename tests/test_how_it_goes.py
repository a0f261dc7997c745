"""How a training goes, episode by episode, without knowing what comes; and how it went."""

import json
from itertools import groupby
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from cprl.measuring.outcome import Course, outcome_of
from cprl.measuring.series import Recent
from cprl.measuring.table import where
from cprl.runs.curves import as_curves
from cprl.runs.episodes import read_episodes, read_rows

RANDOM = 282.0
TRAGEDY = np.repeat([312, 413, 492, 534, 587, 629, 618, 572, 418, 373, 270], 10)
"""Apples of four DQN agents who explore for sixty episodes; issue 17."""
SIXTEEN_WORLDS = (
    *(318, 395, 322, 323, 437, 516, 438, 360, 266, 243, 217, 206),
    *(195, 193, 200, 191, 197, 190),
)
"""Mean apples of each 16 episodes of recipes/tragedy.py, whose random play gets 280; the last ones about."""
RESULTS = Path(__file__).parents[1] / "docs" / "results"
HELD = json.loads((Path(__file__).parent / "golden" / "outcomes.json").read_text())
"""How each replica of the stored runs went, and the labels of all replicas together."""
HELD = json.loads((Path(__file__).parent / "golden" / "outcomes.json").read_text())
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
    recent = Recent(10, share=0.1, each=16)
    for value in range(40):
        recent.add(value)
    assert recent.window == 4, "a tenth of 640 episodes"


def test_noise_around_random_play_is_neither_rise_nor_fall():
    noise = RANDOM + np.random.default_rng(0).normal(0, 20, 500)
    assert labels(noise) == [("begins", 9), ("steady", 491)]


@pytest.mark.parametrize("run", [pytest.param(name, marks=pytest.mark.integration) for name in HELD])
def test_stored_runs_go_and_went_as_they_did(run):
    random = as_curves(read_rows(RESULTS / run / "evaluation" / "random.parquet"))
    level = float(random["collective_return"].mean())
    table, names = read_episodes(RESULTS / run), ("collective_return", "terminated")
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
        seen.append(course.explore({} if epsilon is None else {"agent_0": epsilon, "agent_1": float("nan")}))
    assert seen == expected


def test_the_recent_mean_is_of_a_share_of_the_values_so_far_but_of_some_at_least():
    recent = Recent(3, share=0.5)
    assert [recent.add(value) for value in range(10)] == [0, 0.5, 1, 2, 3, 4, 4.5, 5.5, 6, 7]
    assert recent.window == 5
    assert np.isnan(Recent(3).add(float("nan")))


FALL = [*[100.0] * 20, *[400.0] * 20]


def episodes_of(returns, lives, *, agents=2, worlds=None, replica=0):
    """A table of episodes in which all agents got so much, and boards lasted so long."""
    number = np.arange(len(returns))
    columns = {"replica": np.full(len(number), replica), "episode": number, "collective_return": returns}
    columns |= {"steps": np.broadcast_to(lives, len(number))}
    columns |= {} if worlds is None else {"world": worlds}
    one = {name: np.repeat(np.asarray(column), agents) for name, column in columns.items()}
    return pa.table({**one, "agent": np.tile(np.arange(agents), len(number))})


def word(returns, *, agents=4, worlds=None, lives=(1000, 400)):
    """How a training of one replica went whose boards lasted so long at first, and at the end."""
    steps = np.where(np.arange(len(returns)) < 40, *lives)
    return outcome_of(episodes_of(returns, steps, agents=agents, worlds=worlds), random=100.0).word


@pytest.mark.parametrize(
    ("course", "more", "expected"),
    [
        # Random play gets 100; the peak is 400, a third of its lead over random play is 100.
        ([100.0] * 40, {}, "no better"),
        ([*FALL, *[400.0] * 40], {}, "harvesting"),
        ([*FALL, *[290.0] * 40], {}, "decline"),
        ([*FALL, *[310.0] * 40], {}, "harvesting"),
        ([*FALL, *[90.0] * 40], {}, "tragedy"),
        ([*FALL, *[90.0] * 40], {"agents": 1}, "decline"),
        ([*FALL, *[90.0] * 40], {"lives": (1000, 701)}, "decline"),
        ([*FALL, *[90.0] * 40], {"lives": (1000, 700)}, "tragedy"),
        ([*FALL, *[96.0] * 40], {}, "decline"),
        # From 80 a quarter of the way back to 400 is 160.
        ([*FALL, *[80.0] * 40, *[170.0] * 40], {}, "recovery"),
        ([*FALL, *[80.0] * 40, *[150.0] * 40], {}, "decline"),
    ],
)
def test_how_a_training_went_is_told_by_its_peak_and_its_last_episodes(course, more, expected):
    assert word(course, **more) == expected


def test_a_training_in_many_worlds_went_as_each_of_its_worlds_did():
    # Three worlds fall to nothing, in short episodes; in the time of twenty of them the fourth plays one.
    worlds = np.array([*[0, 1, 2, 3] * 10, *[0, 1, 2] * 20])
    returns = np.where(worlds == 3, 600.0, [*[100.0] * 20, *[400.0] * 20, *[0.0] * 60])
    assert word(returns) == "tragedy"
    assert word(returns, worlds=worlds) == "decline", "600 / 4 is above 95"


def test_the_outcome_over_replicas_is_of_their_mean():
    falls = [[*FALL, *[90.0] * 40], [*FALL, *[70.0] * 50]]
    tables = [episodes_of(returns, 500, replica=replica) for replica, returns in enumerate(falls)]
    went = outcome_of(pa.concat_tables(tables), random=100.0)
    assert (went.begins, went.peak, went.around, went.last) == (100.0, 400.0, 25, 80.0)
    assert went.lived == 1.0
