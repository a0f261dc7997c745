"""What agents want, by numbers worked by hand, and in every learner as on paper."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from matrix_game import MatrixGame, tit_for_tat
from restorable import assert_restorable
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from cprl import CommonsEnv, Game, Rules, maps
from cprl.envs import make_env, parallel_env
from cprl.envs.state import env_state, load_env_state, load_transforms_state, transforms_state
from cprl.objectives.preferences import (
    Exchange,
    InequityAversion,
    PreferenceTransform,
    PreferenceWrapper,
    SocialValueOrientation,
    WantedRewards,
)
from cprl.training.training import StepCollector

AVERSE = InequityAversion(alpha=5, beta=0.05, smoothing=0.9)
FAIR = SocialValueOrientation(angle=math.pi / 4, weight=0.5)
WANTS = {"individual": "individual", "team": "team", "averse": AVERSE, "fair": FAIR, "half": Exchange(0.5)}
MEADOW = Game(
    map=maps.parse(".A>.A.A\nA.A.v.A\n..<.A.A"),
    rules=Rules(regrow_prob=(0.0, 0.2), window_rows=3, window_columns=5, episode_steps=15, freeze_steps=2),
)


def between(low, high):
    """Numbers; subnormal ones are zero once some library has told the processor so."""
    return st.floats(low, high, allow_subnormal=False)


NUMBERS = st.sampled_from([0.0, 1.0, 3.0, -1.0, 0.5, -2.25])
REWARDS = st.tuples(st.integers(1, 3), st.integers(2, 5)).flatmap(
    lambda shape: arrays(np.float32, shape, elements=NUMBERS)
)
SHARES = between(0, 1)
PREFERENCES = st.one_of(
    st.sampled_from(["individual", "team"]),
    st.builds(InequityAversion, alpha=between(0, 5), beta=between(0, 5), smoothing=SHARES),
    st.builds(SocialValueOrientation, angle=between(-math.pi, math.pi), weight=between(0, 5)),
    st.builds(Exchange, SHARES),
)


def wanted_at_first(preference, rewards):
    """What agents want in an episode's first turn."""
    return WantedRewards(preference).add(rewards, np.zeros(len(rewards), np.bool_))


def wanted(preference, *rewards):
    return wanted_at_first(preference, np.array([rewards], np.float32))[0].tolist()


def close(*numbers):
    return pytest.approx(list(numbers), abs=1e-5)


def averse(alpha, beta):
    return InequityAversion(alpha=alpha, beta=beta, smoothing=0)


def orientation(angle, weight):
    return SocialValueOrientation(angle=angle, weight=weight)


@pytest.mark.parametrize(
    ("preference", "rewards", "expected"),
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
def test_what_is_wanted_in_a_turn_is_as_worked_by_hand(preference, rewards, expected):
    assert wanted(preference, *rewards) == close(*expected)


def test_smoothed_rewards_last_into_the_next_turn():
    # smoothing 0.5; rewards 2, 0, then 0, 0. Smoothed: 2, 0, then 1, 0.
    # first turn: 2 - 0.5 x 2 = 1 and 0 - 1 x 2 = -2; second: 0 - 0.5 x 1 = -0.5 and 0 - 1 x 1 = -1
    wants = WantedRewards(InequityAversion(alpha=1, beta=0.5, smoothing=0.5))
    going_on = np.array([False])
    assert wants.add(np.array([[2.0, 0.0]]), going_on)[0].tolist() == close(1, -2)
    assert wants.add(np.array([[0.0, 0.0]]), going_on)[0].tolist() == close(-0.5, -1)


@pytest.mark.parametrize("preference", WANTS.values(), ids=WANTS)
def test_when_nobody_eats_nobody_wants_anything_else(preference):
    # other programs punish all by the angle of (0, 0), taken as 0, or by a difference of nothing
    assert wanted(preference, 0, 0, 0) == [0, 0, 0]
    assert wanted(preference, -0.0, 0, -0.0) == [0, 0, 0]


@settings(deadline=None)
@given(rewards=REWARDS, alpha=between(0, 9), beta=between(0, 9))
def test_being_unequal_never_pays(rewards, alpha, beta):
    got = wanted_at_first(InequityAversion(alpha=alpha, beta=beta, smoothing=0), rewards)
    assert (got <= rewards).all()
    ahead = rewards > rewards.mean(1, keepdims=True)
    if beta > 1e-3:
        assert (got[ahead] < rewards[ahead]).all(), "an aversion that rewards being ahead"


@settings(deadline=None)
@given(preference=PREFERENCES, rewards=REWARDS, data=st.data())
def test_agents_in_another_order_want_the_same_in_that_order(preference, rewards, data):
    order = data.draw(st.permutations(range(rewards.shape[1])))
    got, shuffled = (wanted_at_first(preference, own) for own in (rewards, rewards[:, order]))
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
@given(preference=PREFERENCES, turns=TURNS, data=st.data())
def test_each_world_remembers_its_own_episode_alone(preference, turns, data):
    together, alone, at = WantedRewards(preference), WantedRewards(preference), data.draw(st.integers(0, 2))
    for rewards, ended in turns:
        got = together.add(rewards, ended)
        of_one = alone.add(rewards[at : at + 1], np.array([False]))
        assert np.array_equal(got[at : at + 1], of_one)
        if ended[at]:
            alone = WantedRewards(preference)


@settings(deadline=None)
@given(turns=TURNS, of_each=st.lists(PREFERENCES, min_size=2, max_size=2), data=st.data())
def test_a_state_goes_on_bit_for_bit(turns, of_each, data):
    stop = data.draw(st.integers(0, len(turns)))
    whole, stopped = WantedRewards(of_each), WantedRewards(of_each)
    expected = [whole.add(*turn) for turn in turns]
    found = [stopped.add(*turn) for turn in turns[:stop]]
    resumed = WantedRewards(of_each)
    resumed.load_state_dict(stopped.state_dict())
    found += [resumed.add(*turn) for turn in turns[stop:]]
    assert np.array_equal(np.stack(expected), np.stack(found))
    torch.testing.assert_close(whole.state_dict(), resumed.state_dict(), rtol=0, atol=0)


def test_each_agent_may_want_something_else():
    rewards, ended = np.array([[3.0, 0.0, 1.0]], np.float32), np.array([False])
    got = WantedRewards(["individual", "team", Exchange(0.5)]).add(rewards, ended)
    assert got[0].tolist() == close(3, 4, 1.25)


def test_what_a_transform_remembers_of_its_worlds_is_none_of_what_transforms_have_learned():
    game = Game(map=maps.parse("A>.A\nA.<A"), rules=Rules(regrow_prob=(0.5,)))
    envs = [make_env(game, worlds=worlds, transforms=[PreferenceTransform(AVERSE)]) for worlds in (2, 3)]
    for env in envs:
        env.rollout(4)
    assert transforms_state(envs[0]) == {}
    load_transforms_state(envs[1], env_state(envs[0])["transforms"])
    assert envs[1].transform[0].get_extra_state().shape[1] == 3, "its own three worlds"


class TestRefusals:
    @pytest.mark.parametrize("preference", [AVERSE, FAIR, Exchange(0.5)])
    def test_a_comparison_with_others_is_refused_where_there_are_none(self, preference):
        name = type(preference).__name__
        with pytest.raises(ValueError, match=rf"preferences is {name}, which compares .* a game of 1 agent"):
            wanted(preference, 3)
        alone = Game(map=maps.parse("A.>.A"), rules=Rules(may_fire=False))
        with pytest.raises(ValueError, match=f"preferences is {name}.*allowed there: 'individual', 'team'"):
            TransformedEnv(CommonsEnv(alone, 1), PreferenceTransform(preference)).reward_spec  # noqa: B018
        with pytest.raises(ValueError, match=f"preferences is {name}"):
            PreferenceWrapper(parallel_env(alone), preference)
        assert wanted("individual", 3) == wanted("team", 3) == [3]

    @pytest.mark.parametrize(
        ("make", "message"),
        [
            (lambda: SocialValueOrientation(angle=45, weight=1), "angle is 45"),
            (lambda: WantedRewards("selfish"), "preferences is 'selfish'"),
            (lambda: WantedRewards(["team", 3]), r"preferences\[1\] is 3"),
            (
                lambda: WantedRewards(["team"] * 3).add(np.zeros((1, 2)), np.array([False])),
                "preferences has 3 entries",
            ),
            (lambda: PreferenceTransform(AVERSE)(torch.zeros(1)), "called outside an environment"),
        ],
    )
    def test_what_does_not_fit_is_refused_by_name(self, make, message):
        with pytest.raises(ValueError, match=message):
            make()

    def test_other_worlds_than_before_are_refused_until_what_is_remembered_is_cleared(self):
        wants = WantedRewards(AVERSE)
        wants.add(np.zeros((2, 3)), np.zeros(2, np.bool_))
        with pytest.raises(ValueError, match=r"rewards is \[4, 3\]"):
            wants.add(np.zeros((4, 3)), np.zeros(4, np.bool_))
        wants.clear()
        wants.add(np.zeros((4, 3)), np.zeros(4, np.bool_))
        with pytest.raises(ValueError, match=r"of the state is \[1, 4, 3\]"):
            WantedRewards("team").load_state_dict(wants.state_dict())


def played(env, policy, turns):
    """Batches of so many turns."""
    collected = iter(StepCollector(env, policy))
    return [next(collected).clone() for _ in range(turns)]


class TestAdapters:
    @pytest.mark.parametrize("preference", WANTS.values(), ids=WANTS)
    @pytest.mark.parametrize("out_key", [None, ("agents", "wanted")])
    def test_a_transform_writes_what_learners_want(self, preference, out_key):
        given = played(MatrixGame(3), tit_for_tat, 25)
        transform = PreferenceTransform(preference, out_key=out_key)
        found = played(TransformedEnv(MatrixGame(3), transform), tit_for_tat, 25)
        wants = WantedRewards(preference)
        for before, after in zip(given, found, strict=True):
            rewards = before["next", "agents", "reward"][..., 0]
            expected = wants.add(rewards.numpy(), before["next", "done"][:, 0].numpy())
            got = after["next"][out_key or ("agents", "reward")]
            assert got.dtype == torch.float32
            assert np.array_equal(got[..., 0].numpy(), expected)
            if out_key:
                assert torch.equal(after["next", "agents", "reward"][..., 0], rewards)
        assert len({tuple(own["next", "done"].flatten().tolist()) for own in given}) > 2, "at different times"

    def test_a_transform_has_specs_and_a_state(self):
        make = lambda: TransformedEnv(  # noqa: E731
            CommonsEnv(MEADOW, 2, seed=1), PreferenceTransform([AVERSE, "team", FAIR])
        )
        check_env_specs(make())
        assert_restorable(make)
        one, other = make(), make()
        carried = one.reset()
        for _ in range(9):
            carried = one.step_and_maybe_reset(one.rand_action(carried))[1]
        assert one.transform.state_dict()["_extra_state"].shape == (1, 2, 3)
        other.reset()
        load_env_state(other, env_state(one))
        actions = one.rand_action(carried)
        assert torch.equal(
            one.step(actions.clone())["next", "agents", "reward"],
            other.step(actions.clone())["next", "agents", "reward"],
        )

    def test_a_reset_in_the_middle_of_an_episode_clears_the_worlds_that_it_resets(self):
        transform = PreferenceTransform(AVERSE)
        env = TransformedEnv(MatrixGame(2), transform)
        carried = env.step_and_maybe_reset(tit_for_tat(env.reset()))[1]
        before = transform.get_extra_state()[0].clone()
        assert before.abs().sum(1).min() > 0
        env.reset(carried.set("_reset", torch.tensor([[True], [False]])))
        assert transform.get_extra_state()[0].tolist() == [[0, 0], before[1].tolist()]
        env.reset()
        assert transform.get_extra_state().numel() == 0

    @pytest.mark.parametrize("preference", WANTS.values(), ids=WANTS)
    def test_a_wrapper_gives_what_learners_want(self, preference):
        env, wrapped = (
            parallel_env(MEADOW, seed=4),
            PreferenceWrapper(parallel_env(MEADOW, seed=4), preference),
        )
        rng, eaten = np.random.default_rng(2), 0
        for _ in range(2):
            wants = WantedRewards(preference)
            env.reset()
            wrapped.reset()
            while env.agents:
                actions = {agent: int(rng.integers(4)) for agent in env.agents}
                rewards = env.step(actions)[1]
                _, found, _, _, infos = wrapped.step(actions)
                (expected,) = wants.add(np.array([list(rewards.values())], np.float32), np.array([False]))
                assert list(found.values()) == expected.tolist()
                assert {agent: info["env_reward"] for agent, info in infos.items()} == rewards
                eaten += sum(rewards.values())
            assert wrapped.agents == []
        assert eaten > 3
