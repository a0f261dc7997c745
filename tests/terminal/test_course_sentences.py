"""The course of a run in sentences, from tables whose numbers are known."""

import numpy as np
import pytest
from told_courses import LENGTHS, RISE_AND_FALL, told_of

from cprl.algorithms import DQN, DQNSettings
from cprl.population import Learning, Scripted

QUICK = (Learning(DQN(settings=DQNSettings(epsilon_decay_steps=10_000))),) * 2
WORSE_OFF = "They end worse off than agents who never learned."
CLOSE = {"spread": (-0.1, 0.1)}


def test_the_course_has_the_end_of_the_training_and_fresh_worlds_with_intervals_and_why_they_differ(tmp_path):
    # t of one degree of freedom is 12.7: the last 30 episodes yield 199 and 201 apples, fresh ones 242, 262.
    lines = told_of(tmp_path / "run", RISE_AND_FALL, LENGTHS, agents=QUICK).splitlines()
    assert lines[-1].startswith("Each agent learned to take what pays now")
    assert " ".join(lines) == (
        "The agents began at 300 apples an episode, all together, and reached 600 around episode 25. While "
        "they learn, in the last 30 episodes, they get 200 [187, 213] apples, and boards last 450 [450, 450] "
        "steps. In fresh worlds, where nobody learns and agents act at random in 5% of their steps, not 10%, "
        "they get 252 [125, 379] apples, and boards last 600 [600, 600] steps. By replica that is 242 and "
        "262 apples and 600 and 600 steps; 100% and 100% of the boards die. Random play gets 282 [282, 282] "
        "apples, and boards last 1,000 [1,000, 1,000] steps. Beside random play, in apples, that is -82.0 "
        "[-94.7, -69.3] while they learn and -30 [-157, +97] in fresh worlds. Each agent learned to take "
        "what pays now, and while they learn all of them end worse off than agents who never learned: the "
        "tragedy of the commons. Whether they do in fresh worlds cannot be told."
    )


def test_the_peak_of_a_short_run_is_one_of_its_episodes(tmp_path):
    assert "around episode 2." in told_of(tmp_path / "run", [300.0, 310.0], [1000.0] * 2)


@pytest.mark.parametrize(
    ("returns", "lengths", "change", "ending"),
    [
        (
            RISE_AND_FALL[:60],
            LENGTHS[:60],
            {"fresh": ((600.0,), (1000.0,))},
            "They end better off than agents who never learned: no tragedy so far.",
        ),
        ([*RISE_AND_FALL[:60], *[275.0] * 40], LENGTHS, CLOSE, WORSE_OFF),
        ([*[300.0] * 20, *[400.0] * 40, *[200.0] * 40], LENGTHS, CLOSE, WORSE_OFF),
        (RISE_AND_FALL, [1000.0] * 100, CLOSE, WORSE_OFF),
        (
            RISE_AND_FALL,
            LENGTHS,
            {"spread": (-10.0, 10.0)},
            "Whether they end better or worse off than agents who never learned cannot be told.",
        ),
        (
            RISE_AND_FALL[:60],
            LENGTHS[:60],
            {},
            "While they learn they end better off than agents who never learned. "
            "Whether they do in fresh worlds cannot be told.",
        ),
        (
            RISE_AND_FALL,
            LENGTHS,
            {"spread": (0.0,)},
            "Whether they end better or worse off than agents who never learned cannot be told: "
            "one replica has no interval.",
        ),
    ],
    ids=["rises only", "falls too little", "low peak", "boards last", "wide", "fresh wide", "one replica"],
)
def test_what_is_no_tragedy_over_replicas_is_called_none(tmp_path, returns, lengths, change, ending):
    told = told_of(tmp_path / "run", returns, lengths, **change)
    assert told.endswith(ending)
    assert "the tragedy of the commons" not in told


def test_one_replica_has_no_interval(tmp_path):
    told = told_of(tmp_path / "run", RISE_AND_FALL, LENGTHS, spread=(0.0,))
    assert "they get 200 apples, and boards last 450 steps." in told
    assert "[" not in told


def test_an_interval_does_not_pass_zero_nor_the_clock(tmp_path):
    told = told_of(tmp_path / "run", [10.0] * 40, [1000.0] * 40, spread=(-9.0, 9.0))
    assert "they get 10 [0, 124] apples" in told


def test_many_replicas_are_not_told_one_by_one(tmp_path):
    told = told_of(tmp_path / "run", RISE_AND_FALL, LENGTHS, spread=np.linspace(-1, 1, 6))
    assert "By replica" not in told


def test_of_many_worlds_the_last_episodes_of_each_are_told(tmp_path):
    worlds = np.array([*[0, 1, 2, 3] * 8, *[0, 1, 2] * 20])  # the fourth is still in its ninth episode
    returns = np.where(worlds == 3, 400.0, 100.0)
    told = told_of(tmp_path / "run", returns, [1000.0] * len(worlds), worlds=worlds)
    assert "in the last 8 episodes of each of 4 worlds, they get 175 [162, 188] apples" in told
    assert "began at 175 apples" in told


def test_scripted_agents_have_no_training_to_tell_of(tmp_path):
    told = told_of(tmp_path / "run", RISE_AND_FALL, LENGTHS, agents=(Scripted("greedy"),) * 2)
    assert told.startswith("In fresh worlds they get 252 [125, 379] apples")
    assert "learn" not in told
    assert told.endswith("Whether they end better or worse off than random play cannot be told.")


def test_nothing_harvested_is_told_and_a_game_without_a_harvest_has_no_course(tmp_path):
    idle = told_of(tmp_path / "idle", [0.0] * 40, [1000.0] * 40, random=(0.0,), spread=(0.0, 0.0))
    assert "they get 0 [0, 0] apples" in idle
    with pytest.raises(ValueError, match="lack collective_return"):
        told_of(tmp_path / "run", RISE_AND_FALL, LENGTHS, lacks="collective_return")
