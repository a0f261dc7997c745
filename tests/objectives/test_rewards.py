"""What agents want, by numbers worked by hand, and in every learner as on paper."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays

from cprl.objectives.rewards import Exchange, InequityAversion, RewardModel, SocialValueOrientation

AVERSE = InequityAversion(alpha=5, beta=0.05, smoothing=0.9)
FAIR = SocialValueOrientation(angle=math.pi / 4, weight=0.5)
WANTS = {"individual": "individual", "team": "team", "averse": AVERSE, "fair": FAIR, "half": Exchange(0.5)}


def between(low, high):
    """Numbers; subnormal ones are zero once some library has told the processor so."""
    return st.floats(low, high, allow_subnormal=False)


NUMBERS = st.sampled_from([0.0, 1.0, 3.0, -1.0, 0.5, -2.25])
REWARDS = st.tuples(st.integers(1, 3), st.integers(2, 5)).flatmap(
    lambda shape: arrays(np.float32, shape, elements=NUMBERS)
)
SHARES = between(0, 1)
KINDS = st.one_of(
    st.sampled_from(["individual", "team"]),
    st.builds(InequityAversion, alpha=between(0, 5), beta=between(0, 5), smoothing=SHARES),
    st.builds(SocialValueOrientation, angle=between(-math.pi, math.pi), weight=between(0, 5)),
    st.builds(Exchange, SHARES),
)


def wanted_at_first(reward, rewards):
    """What agents want in an episode's first turn."""
    return RewardModel(reward).add(rewards, np.zeros(len(rewards), np.bool_))


def wanted(reward, *rewards):
    return wanted_at_first(reward, np.array([rewards], np.float32))[0].tolist()


def close(*numbers):
    return pytest.approx(list(numbers), abs=1e-5)


def averse(alpha, beta):
    return InequityAversion(alpha=alpha, beta=beta, smoothing=0)


def orientation(angle, weight):
    return SocialValueOrientation(angle=angle, weight=weight)


@pytest.mark.parametrize(
    ("reward", "rewards", "expected"),
    [
        # own 3, other 0: 3 - 0.05 x (3 - 0) = 2.85; own 0, other 3: 0 - 5 x (3 - 0) = -15
        (averse(5, 0.05), (3, 0), (2.85, -15)),
        (averse(0, 0.05), (3, 0), (2.85, 0)),
        # of 4, 1, 1: the first leads by 3 and 3: 4 - 0.5 x (3 + 3) / 2 = 2.5; the others lag by 3 behind one
        # of two: 1 - 2 x 3 / 2 = -2
        (averse(2, 0.5), (4, 1, 1), (2.5, -2, -2)),
        # own 1, mean of the others (0 + 2) / 2 = 1: the angle is pi / 4. Selfish, weight 0.5: 1 - 0.5 pi / 4.
        # own 0, mean 1.5: pi / 2. own 2, mean 0.5: atan(1 / 4).
        (orientation(0, 0.5), (1, 0, 2), (1 - math.pi / 8, -math.pi / 4, 2 - 0.5 * math.atan(0.25))),
        # own 3, others 0: the angle is 0, and pi / 4 is liked: 3 - 0.5 pi / 4; the others see 0 and 1.5,
        # an angle of pi / 2, likewise pi / 4 away
        (FAIR, (3, 0, 0), (3 - math.pi / 8, -math.pi / 8, -math.pi / 8)),
        (FAIR, (1, 1), (1, 1)),
        # both lose 1: atan2(-1, -1) = -3 pi / 4; from pi / 2 that is 5 pi / 4, or 3 pi / 4 the shorter way
        (orientation(math.pi / 2, 1), (-1, -1), [-1 - 3 * math.pi / 4] * 2),
        # 3, 0, 1 with half: 1.5 + 0.5 x 0.5 = 1.75; 0 + 0.5 x 2 = 1; 0.5 + 0.5 x 1.5 = 1.25
        (Exchange(0.5), (3, 0, 1), (1.75, 1, 1.25)),
        ("team", (3, 0, 1), (4, 4, 4)),
    ],
)
def test_what_is_wanted_in_a_turn_is_as_worked_by_hand(reward, rewards, expected):
    assert wanted(reward, *rewards) == close(*expected)


def test_smoothed_rewards_last_into_the_next_turn():
    # smoothing 0.5; rewards 2, 0, then 0, 0. Smoothed: 2, 0, then 1, 0.
    # first turn: 2 - 0.5 x 2 = 1 and 0 - 1 x 2 = -2; second: 0 - 0.5 x 1 = -0.5 and 0 - 1 x 1 = -1
    model = RewardModel(InequityAversion(alpha=1, beta=0.5, smoothing=0.5))
    going_on = np.array([False])
    assert model.add(np.array([[2.0, 0.0]]), going_on)[0].tolist() == close(1, -2)
    assert model.add(np.array([[0.0, 0.0]]), going_on)[0].tolist() == close(-0.5, -1)


@pytest.mark.parametrize("reward", WANTS.values(), ids=WANTS)
def test_when_nobody_eats_nobody_wants_anything_else(reward):
    # other programs punish all by the angle of (0, 0), taken as 0, or by a difference of nothing
    assert wanted(reward, 0, 0, 0) == [0, 0, 0]
    assert wanted(reward, -0.0, 0, -0.0) == [0, 0, 0]


@settings(deadline=None)
@given(rewards=REWARDS, alpha=between(0, 9), beta=between(0, 9))
def test_being_unequal_never_pays(rewards, alpha, beta):
    got = wanted_at_first(InequityAversion(alpha=alpha, beta=beta, smoothing=0), rewards)
    assert (got <= rewards).all()
    ahead = rewards > rewards.mean(1, keepdims=True)
    if beta > 1e-3:
        assert (got[ahead] < rewards[ahead]).all(), "an aversion that rewards being ahead"


@settings(deadline=None)
@given(reward=KINDS, rewards=REWARDS, data=st.data())
def test_agents_in_another_order_want_the_same_in_that_order(reward, rewards, data):
    order = data.draw(st.permutations(range(rewards.shape[1])))
    got, shuffled = (wanted_at_first(reward, own) for own in (rewards, rewards[:, order]))
    np.testing.assert_allclose(shuffled, got[:, order], rtol=1e-5, atol=1e-6)


@settings(deadline=None)
@given(rewards=REWARDS, share=SHARES, angle=between(-3, 3))
def test_without_a_weight_the_own_reward_is_wanted_and_an_exchange_keeps_the_sum(rewards, share, angle):
    for idle in (
        InequityAversion(alpha=0, beta=0, smoothing=share),
        SocialValueOrientation(angle=angle, weight=0),
        Exchange(0),
    ):
        assert np.array_equal(wanted_at_first(idle, rewards), rewards)
    exchanged = wanted_at_first(Exchange(share), rewards)
    np.testing.assert_allclose(exchanged.sum(1), rewards.sum(1), atol=1e-5)


TURNS = st.lists(
    st.tuples(arrays(np.float32, (3, 2), elements=NUMBERS), arrays(np.bool_, 3)), min_size=2, max_size=8
)


@pytest.mark.integration
@settings(deadline=None)
@given(reward=KINDS, turns=TURNS, data=st.data())
def test_each_world_remembers_its_own_episode_alone(reward, turns, data):
    together, alone, at = RewardModel(reward), RewardModel(reward), data.draw(st.integers(0, 2))
    for rewards, ended in turns:
        got = together.add(rewards, ended)
        of_one = alone.add(rewards[at : at + 1], np.array([False]))
        assert np.array_equal(got[at : at + 1], of_one)
        if ended[at]:
            alone = RewardModel(reward)


@settings(deadline=None)
@given(turns=TURNS, reward=KINDS, data=st.data())
def test_a_state_goes_on_bit_for_bit(turns, reward, data):
    stop = data.draw(st.integers(0, len(turns)))
    whole, stopped = RewardModel(reward), RewardModel(reward)
    expected = [whole.add(*turn) for turn in turns]
    found = [stopped.add(*turn) for turn in turns[:stop]]
    resumed = RewardModel(reward)
    resumed.load_state_dict(stopped.state_dict())
    found += [resumed.add(*turn) for turn in turns[stop:]]
    assert np.array_equal(np.stack(expected), np.stack(found))
    torch.testing.assert_close(whole.state_dict(), resumed.state_dict(), rtol=0, atol=0)


class TestRefusals:
    @pytest.mark.parametrize("reward", [AVERSE, FAIR, Exchange(0.5)])
    def test_a_comparison_with_others_is_refused_where_there_are_none(self, reward):
        name = type(reward).__name__
        with pytest.raises(ValueError, match=rf"reward is {name}, which compares .* a game of 1 agent"):
            wanted(reward, 3)
        assert wanted("individual", 3) == wanted("team", 3) == [3]

    @pytest.mark.parametrize(
        ("make", "message"),
        [
            (lambda: SocialValueOrientation(angle=45, weight=1), "angle is 45"),
            (lambda: RewardModel("selfish"), "reward is 'selfish'"),
        ],
    )
    def test_what_does_not_fit_is_refused_by_name(self, make, message):
        with pytest.raises(ValueError, match=message):
            make()

    def test_other_worlds_than_before_are_refused_until_what_is_remembered_is_cleared(self):
        model = RewardModel(AVERSE)
        model.add(np.zeros((2, 3)), np.zeros(2, np.bool_))
        with pytest.raises(ValueError, match=r"rewards is \[4, 3\]"):
            model.add(np.zeros((4, 3)), np.zeros(4, np.bool_))
        model.clear()
        model.add(np.zeros((4, 3)), np.zeros(4, np.bool_))
        with pytest.raises(ValueError, match=r"of the state is \[4, 3\]"):
            RewardModel("team").load_state_dict(model.state_dict())


@pytest.mark.parametrize("reward", WANTS.values(), ids=WANTS)
def test_rewards_that_are_tensors_give_tensors(reward):
    rewards, ended = np.array([[3.0, 0.0, 1.0]], np.float32), np.array([False])
    found = RewardModel(reward).add(torch.from_numpy(rewards), torch.from_numpy(ended))
    assert np.array_equal(found.numpy(), RewardModel(reward).add(rewards, ended))
