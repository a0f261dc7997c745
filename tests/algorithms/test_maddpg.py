"""MADDPG: critics that see the whole team, rewards of one's own, gradients through one-hot actions."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
import torch
from dqn_parts import MEADOW, make_learner, played, transitions
from matrix_games import MatrixGame
from small_learners import GAME, REPLAY
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.objectives import DQNLoss, SoftUpdate, ValueEstimators

from cprl import CommonsEnv
from cprl.algorithms import DQN, MADDPG, DQNSettings
from cprl.algorithms.base import q_actor
from cprl.envs import make_env
from cprl.learners.ring import Ring
from cprl.learners.transitions import Horizon, LaneTurn, TransitionForm
from cprl.networks import MLP
from cprl.objectives import MADDPGLoss
from cprl.objectives.maddpg import sampled_one_hot, straight_through
from cprl.population import Team
from cprl.training.agents import Population

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater:UserWarning")


class Linear(nn.Module):
    """A linear map for each member, without a bias: [.., S, in] to [.., S, out]."""

    def __init__(self, *weight):
        super().__init__()
        self.weight = nn.Parameter(torch.tensor(weight))

    def forward(self, values):
        return torch.einsum("...si,sio->...so", values, self.weight)


class LinearCritics(Linear):
    """Of the actions of all members alone: [.., S, S, A] to [.., S, 1]."""

    def forward(self, joint_action):
        return super().forward(joint_action.flatten(-2))


def loss_of(actors, critics, *, sees=("joint_action",), gamma=0.5, **how):
    actor = TensorDictModule(actors, ["observation"], ["logits"])
    critic = TensorDictModule(critics, list(sees), ["state_action_value"])
    loss = MADDPGLoss(actor, critic, logit_penalty=how.pop("logit_penalty", 0.0), **how)
    return loss.make_value_estimator(ValueEstimators.TD0, gamma=gamma)


# Member 0 takes action 1 where it sees 1, else action 0 where it sees -1; member 1 the other way round.
SURE = [[[-50.0, 50.0]], [[50.0, -50.0]]]
# The critic of member 0 values its own actions at 1 and 2, the other's at 3 and 4; that of member 1 values
# the actions of member 0 at 10 and 20, its own at 30 and 40.
VALUES = [[[1.0], [2.0], [3.0], [4.0]], [[10.0], [20.0], [30.0], [40.0]]]


def two_transitions(**entries):
    seen_next, reward = [[[1.0], [1.0]], [[1.0], [-1.0]]], [[[5.0], [6.0]], [[7.0], [8.0]]]
    entries = {"noise": torch.full((2, 2, 2), 0.5), **entries}
    return transitions(torch.ones(2, 2, 1), [[0, 1], [1, 0]], seen_next, reward, [[False], [True]], **entries)


def test_targets_are_those_of_the_target_policies_and_target_critics():
    loss = loss_of(Linear(*SURE), LinearCritics(*VALUES))
    loss.actor_network_params.data.zero_()  # neither moves the targets
    loss.critic_network_params.data.zero_()
    out = loss(two_transitions())
    # After the first transition both see 1: member 0 takes action 1, member 1 action 0, which is worth
    # 2 + 3 = 5 to member 0 and 20 + 30 = 50 to member 1: 5 + 0.5 * 5 = 7.5, 6 + 0.5 * 50 = 31. The second
    # ends.
    assert out["target_value"].squeeze(-1).tolist() == [[7.5, 31.0], [7.0, 8.0]]
    # The critics say 0: squares 56.25 + 961 and 49 + 64, summed over members, of which the mean is 565.125.
    assert out["loss_value"].item() == 565.125


def test_critics_judge_the_actions_that_were_taken_and_several_steps_are_discounted():
    loss = loss_of(Linear(*SURE), LinearCritics(*VALUES), reduction="none")
    batch = two_transitions(steps_to_next_obs=[[2], [1]])
    out = loss(batch)
    # (0, 1) is worth 1 + 4 to member 0 and 10 + 40 to member 1; (1, 0) is worth 2 + 3 and 20 + 30.
    assert out["pred_value"].squeeze(-1).tolist() == [[5.0, 50.0], [5.0, 50.0]]
    # 5 + 0.25 * 5 = 6.25 and 6 + 0.25 * 50 = 18.5.
    assert out["target_value"].squeeze(-1).tolist() == [[6.25, 18.5], [7.0, 8.0]]
    assert out["loss_value"].tolist() == [1.25**2 + 31.5**2, 2.0**2 + 42.0**2]
    assert set(batch.keys()) == {"observation", "action", "noise", "next", "steps_to_next_obs"}, (
        "not written to"
    )


def test_an_actors_own_action_is_a_new_one_and_the_others_are_those_of_the_batch():
    loss = loss_of(Linear(*SURE), LinearCritics(*VALUES), reduction="none", logit_penalty=0.1)
    out = loss(two_transitions())
    # Both see 1, so member 0 would take action 1, member 1 action 0. In the first transition (0, 1) was
    # taken: to member 0 it is worth 2 + 4, to member 1 10 + 30; in the second 2 + 3 and 20 + 30. All logits
    # are 50 or -50: 0.1 * 2500 for each member.
    assert out["loss_actor"].tolist() == [500.0 - 6.0 - 40.0, 500.0 - 5.0 - 50.0]
    loss.zero_grad()
    out["loss_actor"].sum().backward()
    assert all(weight.grad is None for weight in loss.critic_network_params.values(True, True))


def samples_of(probs):
    """For each action a uniform number that samples it, [A]."""
    return probs.cumsum(-1) - probs / 2


def enumerated(loss, batch, probs):
    """The actors' gradient, averaged over what the only two members sample, by the chance of each."""
    total = 0.0
    weight = loss.actor_network_params.get(("module", "weight"))
    for first, noise in zip(probs[0], samples_of(probs[0]), strict=True):
        for second, other in zip(probs[1], samples_of(probs[1]), strict=True):
            batch["noise"] = torch.stack([torch.zeros(2), torch.stack([noise, other])], -1)[None]
            (slope,) = torch.autograd.grad(loss(batch)["loss_actor"], weight)
            total = total + first * second * slope
    return total


def test_where_a_critic_is_linear_in_the_action_the_gradient_is_that_of_the_expected_value():
    chance = torch.Generator().manual_seed(4)
    actors = Linear(*torch.randn(2, 3, 4, generator=chance).tolist())
    critics = LinearCritics(*torch.randn(2, 8, 1, generator=chance).tolist())
    loss = loss_of(actors, critics)
    seen = torch.randn(1, 2, 3, generator=chance)
    batch = transitions(seen, [[2, 0]], seen, torch.zeros(1, 2, 1), [[False]])
    weight = loss.actor_network_params.get(("module", "weight"))
    probs = torch.einsum("si,sio->so", seen[0], weight).softmax(-1)
    # E Q of a member over its own actions; the other's value is a constant.
    own = torch.stack(
        [loss.critic_network_params.get(("module", "weight"))[i, 4 * i : 4 * i + 4, 0] for i in (0, 1)]
    )
    (wanted,) = torch.autograd.grad(-(probs * own.detach()).sum(), weight)
    got = enumerated(loss, batch, probs.detach())
    assert float((got - wanted).norm() / wanted.norm()) < 1e-5  # 0.02 was asked for
    assert float(wanted.norm()) > 0.1


def test_samples_invert_the_cumulative_distribution():
    probs = torch.tensor([0.25, 0.5, 0.25])
    noise = torch.tensor([0.0, 0.2499, 0.25, 0.7499, 0.75, 1.0])
    assert sampled_one_hot(probs.expand(6, 3), noise).argmax(-1).tolist() == [0, 0, 1, 1, 2, 2]
    logits = probs.log().requires_grad_()
    sample = straight_through(logits, torch.tensor(0.6))
    assert sample.tolist() == [0.0, 1.0, 0.0]
    (slope,) = torch.autograd.grad(sample[1], logits)  # of the probability 0.5: 0.5 * (delta - probs)
    assert slope.tolist() == [-0.125, 0.25, -0.125]


def test_samples_come_from_the_noise_of_the_batch_and_none_from_torchs_generator():
    loss = loss_of(Linear([[0.0, 0.0]], [[0.0, 0.0]]), LinearCritics(*VALUES), reduction="none")
    before = torch.random.get_rng_state()
    seen = []
    for seed in (1, 2, 1):
        chance = torch.Generator().manual_seed(seed)
        given = [torch.rand(2, 2, 2, generator=chance) for _ in range(8)]
        seen.append([loss(two_transitions(noise=noise))["loss_actor"].tolist() for noise in given])
    assert seen[0] == seen[2] != seen[1]
    assert torch.equal(torch.random.get_rng_state(), before)


def test_a_batch_without_noise_is_refused_by_name():
    loss = loss_of(Linear(*SURE), LinearCritics(*VALUES))
    assert "noise" in loss.in_keys
    with pytest.raises(ValueError, match=r'"noise" is missing; allowed: float \[.., members, 2\]'):
        loss(two_transitions().exclude("noise"))
    loss.set_keys(noise="uniform")
    with pytest.raises(ValueError, match='"uniform" is missing'):
        loss(two_transitions())


@pytest.mark.integration
def test_the_loss_works_with_torchrl_alone():
    """Two agents are paid 2 if both choose action 1, 1 if both choose 0; from chance play, they learn to."""
    torch.manual_seed(0)
    action = torch.randint(2, (400, 2))
    paid = (action[:, 0] == action[:, 1]) * (1.0 + action[:, 0])
    see, over = torch.ones(400, 2, 1), torch.ones(400, 1, dtype=torch.bool)
    group = {"observation": see, "reward": paid[:, None, None].expand(400, 2, 1).clone()}
    after = TensorDict({"agents": TensorDict(group, [400, 2]), "done": over, "terminated": over}, [400])
    own = TensorDict({"observation": see, "action": action}, [400, 2])
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(400), batch_size=32)
    buffer.extend(TensorDict({"agents": own, "next": after}, [400]))
    actors, hidden = (
        Linear([[0.0, 0.0]], [[0.0, 0.0]]),
        nn.Sequential(nn.Linear(4, 16), nn.ReLU(), nn.Linear(16, 1)),
    )
    loss = MADDPGLoss(
        TensorDictModule(actors, [("agents", "observation")], [("agents", "logits")]),
        TensorDictModule(nn.Sequential(nn.Flatten(2), hidden), ["joint_action"], ["state_action_value"]),
    )
    loss.set_keys(action=("agents", "action"), reward=("agents", "reward"))
    updater, optimizer = SoftUpdate(loss, tau=0.05), torch.optim.Adam(loss.parameters(), lr=0.02)
    before = loss.target_actor_network_params.get(("module", "weight")).clone()
    for _ in range(200):
        batch = buffer.sample()
        out = loss(batch.set("noise", torch.rand(32, 2, 2)))
        optimizer.zero_grad()
        (out["loss_actor"] + out["loss_value"]).backward()
        optimizer.step()
        updater.step()
    likely = actors(see[:1]).softmax(-1)[0, :, 1]
    assert (likely > 0.9).all(), likely
    assert not torch.equal(loss.target_actor_network_params.get(("module", "weight")), before)
    assert out["loss_value"].item() < 0.05
    assert ("agents", "action") in loss.in_keys
    assert ("next", "agents", "reward") in loss.in_keys


def test_another_estimator_than_td0_is_refused():
    loss = loss_of(Linear(*SURE), LinearCritics(*VALUES))
    with pytest.raises(NotImplementedError, match="TDLambda"):
        loss.make_value_estimator(ValueEstimators.TDLambda)


# ---- in the library


def test_the_critic_of_a_member_sees_what_all_members_do_and_observe_the_actor_only_its_own():
    algorithm = MADDPG(settings=REPLAY)
    team = algorithm.make_team([algorithm.make_network(GAME.spaces) for _ in range(3)], GAME.spaces)
    seen = torch.randint(256, (2, 3, *GAME.observation_shape), dtype=torch.uint8)
    other = seen.clone()
    other[:, 2] = 255 - other[:, 2]
    action = nn.functional.one_hot(torch.zeros(2, 3, 3, dtype=torch.int64), 8).float()
    assert (team["critic"](seen, action) != team["critic"](other, action)).all()
    moved = action.clone()
    moved[:, 1, 2] = nn.functional.one_hot(torch.tensor(5), 8)  # in the row of member 1 alone
    changed = (team["critic"](seen, action) != team["critic"](seen, moved)).squeeze(-1)
    assert changed.tolist() == [[False, True, False]] * 2
    assert (team["actor"](seen) != team["actor"](other)).any(-1).tolist() == [[False, False, True]] * 2


@pytest.mark.parametrize("network", [None, MLP(hidden_cells=(5, 4))])
def test_the_layers_of_critics_are_those_of_the_settings_or_of_the_network(network):
    algorithm = MADDPG(
        settings=replace(REPLAY, hidden_cells=(32, 32) if network else (5, 4)), network=network
    )
    team = algorithm.make_team([algorithm.make_network(GAME.spaces) for _ in range(2)], GAME.spaces)
    layers = [tuple(own.shape[1:]) for own in team["critic"].heads.members.weights]
    assert layers == [(106, 5), (5, 4), (4, 1)]


def test_returns_of_several_steps_are_those_of_each_member():
    """Rewards 1, 2, 4, 8 .. of member 0, ten times that of member 1; the episode ends with the third turn."""
    form = TransitionForm(
        observation_shape=(2, 1), action_shape=(2,), reward_shape=(2,), horizon=Horizon(3, 0.5)
    )
    buffer = Ring(form, seeds=[(0,), (1,)], transitions=10, batch_size=4)
    see, act = np.zeros((2, 2, 1), np.uint8), np.zeros((2, 2), np.int64)
    for step in range(6):
        paid, ends = 2.0**step * np.array([[1.0, 10.0], [3.0, 30.0]], np.float32), np.full(2, step == 2)
        buffer.write(LaneTurn(see, act, see, paid, ends, ends))
    got = buffer.get(torch.tensor([[0, 1, 3], [0, 2, 3]]))
    # 1 + 2/2 + 4/4 = 3; 2 + 4/2 = 4, since the episode ends; 4; 8 + 16/2 + 32/4 = 24.
    wanted = [[[3, 30], [4, 40], [24, 240]], [[9, 90], [12, 120], [72, 720]]]
    assert got["next", "reward"].squeeze(-1).tolist() == wanted
    assert got["steps_to_next_obs"].squeeze(-1).tolist() == [[3, 2, 3], [3, 1, 3]]


# ---- noise, for any algorithm that samples


class NoisyLoss(DQNLoss):
    """Keeps the uniform numbers that it is given."""

    given: ClassVar[list] = []

    def forward(self, tensordict):
        self.given.append(tensordict["noise"])
        return super().forward(tensordict)


@dataclass(frozen=True, kw_only=True)
class Noisy(DQN):
    noise_numbers: ClassVar[int] = 3
    update = "stacked"

    def make_loss(self, network):
        loss = NoisyLoss(q_actor(network), delay_value=True, action_space="categorical")
        loss.make_value_estimator(ValueEstimators.TD0, gamma=self.settings.gamma)
        return loss


def test_maddpg_without_noise_is_refused_before_anything_is_learned():
    without = type("Without", (MADDPG,), {"noise_numbers": 0})(settings=REPLAY)
    with pytest.raises(ValueError, match='"noise" is missing; allowed'):
        make_learner(without, MEADOW.spaces, agents=(0, 1), replicas=1, engine="eager")


@pytest.mark.integration
@pytest.mark.parametrize("engine", ["eager", "torchrl"])
def test_each_lane_has_uniform_numbers_of_its_own_whatever_trains_beside_it(engine):
    given = []
    for replicas, first in ((3, 0), (1, 2)):
        how = {"agents": (0, 1), "replicas": replicas, "first_replica": first, "seed": 3, "engine": engine}
        learner = make_learner(Noisy(settings=REPLAY), MEADOW.spaces, **how)
        NoisyLoss.given.clear()
        played(learner, CommonsEnv(MEADOW, replicas, seed=3), 30)
        given.append(torch.stack(NoisyLoss.given).view(15, 2 * replicas, REPLAY.batch_size, 3))
    assert torch.equal(given[0][:, 4:], given[1])
    numbers = given[0].flatten()
    assert len(numbers.unique()) > 0.99 * len(numbers)
    assert 0.45 < float(numbers.mean()) < 0.55
    assert ((numbers >= 0) & (numbers <= 1)).all()


# ---- games with known answers

REPLICAS = 10
SETTINGS = DQNSettings(
    buffer_size=5000,
    batch_size=32,
    learning_starts=100,
    hidden_cells=(64, 64),
    gamma=0.95,
    learning_rate=3e-3,
    tau=0.01,
)


def expected_returns(payoffs, *, turns):
    """What members of a team get on average by their policies, after so many turns of a matrix game, in each
    replica."""
    table = np.asarray(payoffs)
    game = MatrixGame(table)
    env = make_env(game, worlds=REPLICAS, seed=1)
    team = Team(MADDPG(settings=SETTINGS), tuple(range(game.agents)), reward="individual")
    (learner,) = Population(env, [team], seed=1, engine="eager").learners.values()
    played(learner, env, turns)
    probs = learner.evaluation_actor(1).action_values(env.reset()["agents", "observation"]).numpy()
    found = []
    for of_agents in probs:
        value = table
        for own in of_agents:  # over the first axis that is left
            value = np.tensordot(own, value, 1)
        found.append(value.mean())
    return found


@pytest.mark.slow
def test_six_agents_who_are_paid_if_all_do_the_same_agree_within_3000_turns():
    """The game of proposition 1 of Lowe et al. (2017): from uniform policies, the gradient that a policy
    estimates from one turn points the right way with a probability of the order of 0.5**N. The best is 1."""
    payoffs = np.zeros((2,) * 6 + (6,))
    payoffs[(0,) * 6] = payoffs[(1,) * 6] = 1.0
    returns = expected_returns(payoffs, turns=3000)
    assert sum(value > 0.9 for value in returns) >= 9, returns


@pytest.mark.slow
def test_in_the_penalty_game_without_a_penalty_both_find_one_of_the_two_best():
    """Of Claus and Boutilier, "The Dynamics of Reinforcement Learning in Cooperative Multiagent Systems"
    (1998), with k = 0: the best is 10, and two joint actions give it; a third equilibrium gives 2."""
    table = np.array([[10.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 10.0]])
    returns = expected_returns(np.stack([table, table], -1), turns=2000)
    assert sum(value > 9.8 for value in returns) >= 9, returns
