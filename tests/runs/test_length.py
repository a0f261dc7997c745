"""A training is so many episodes or so many steps long, and is extended by more of the same."""

import pytest

from cprl.runs.length import Length, without_length

EPISODES = Length(12, "episodes")
STEPS = Length(30_000, "steps", clock=1000)


def test_it_is_read_from_the_table_of_an_experiment_and_said_in_words():
    assert Length.of({"episodes": 12, "steps": None}) == EPISODES
    assert Length.of({"episodes": None, "steps": 30_000}) == STEPS, "whatever the clock"
    assert (str(EPISODES), str(STEPS)) == ("12 episodes", "30,000 steps")
    assert (EPISODES.flag, STEPS.flag) == ("--episodes", "--steps")
    assert without_length({"seed": 1, "episodes": 12}) == {"seed": 1, "episodes": None, "steps": None}


@pytest.mark.parametrize(
    ("length", "episodes", "steps", "is_over"),
    [
        (EPISODES, 11, 99_000, False),
        (EPISODES, 12, 0, True),
        (STEPS, 99, 29_999, False),
        (STEPS, 0, 30_000, True),
    ],
)
def test_it_is_over_when_its_own_unit_says_so(length, episodes, steps, is_over):
    assert length.is_over(episodes=episodes, steps=steps) == is_over


def test_episodes_are_expected_to_last_as_long_as_the_clock_lets_them():
    assert EPISODES.episodes == 12
    assert STEPS.episodes == 30
    assert Length(30_001, "steps", clock=1000).episodes == 31
    assert Length(30_000, "steps").episodes == 1, "without a clock"


def test_more_of_the_same_unit_extends_it():
    assert EPISODES.is_shorter_than(Length(13, "episodes"))
    assert not EPISODES.is_shorter_than(EPISODES)
    assert not EPISODES.is_shorter_than(STEPS)
    damaged = Length.of({"episodes": "many"})
    assert not damaged.is_shorter_than(EPISODES)
