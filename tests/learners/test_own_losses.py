"""Losses of a user's own: lanes end as those that learn alone, and what a loss keeps is resumed."""

import re
import warnings
from copy import deepcopy
from dataclasses import replace
from functools import partial
from io import BytesIO

import numpy as np
import pytest
import torch
from c51 import C51
from cql import CQL
from dqn_parts import MEADOW as GAME, make_learner
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import QValueActor
from torchrl.objectives import ClipPPOLoss, DQNLoss

from cprl import CommonsEnv, keys
from cprl.algorithms import (
    A2C,
    DQN,
    IPPO,
    MADDPG,
    MAPPO,
    PPO,
    QMIX,
    SAC,
    DQNSettings,
    OffPolicy,
    OnPolicy,
    RolloutSettings,
)
from cprl.algorithms.base import actor_critic_loss
from cprl.learners.replay import Replay
from cprl.learners.rollouts import STATE_NAMES
from cprl.networks import GRU
from cprl.networks.agent import AgentNetworks
from cprl.policies.actors import LaneActor
from cprl.policies.joint_policy import JointPolicy
from cprl.values import Custom

REPLICAS, TURNS = 3, 40
SETTINGS = DQNSettings(
    buffer_size=60,
    batch_size=8,
    learning_starts=8,
    learning_rate=0.01,
    adam_eps=1e-3,  # smaller ones make steps of gradients that are nothing but rounding
    hidden_cells=(12,),
    target_every_episodes=1,
)
ROLLOUTS = RolloutSettings(
    rollout_steps=10, minibatch_size=5, epochs=2, learning_rate=0.01, adam_eps=1e-3, hidden_cells=(12,)
)


def rewarded(batch, change):
    """A batch with other rewards."""
    batch = batch.clone()
    batch["next", "reward"] = change(batch["next", "reward"])
    return batch


EMPTY = object()
"""A buffer without a tensor."""


def shaping(shape, **start):
    """A kind of DQN loss that shapes rewards, and keeps what it starts with: tensors are buffers."""

    class Shaping(DQNLoss):
        def __init__(self, *parts, **options):
            super().__init__(*parts, **options)
            for name, value in start.items():
                if value is EMPTY or isinstance(value, torch.Tensor):
                    self.register_buffer(name, None if value is EMPTY else value.clone())
                else:
                    setattr(self, name, deepcopy(value))

        def forward(self, batch):
            return super().forward(rewarded(batch, partial(shape, self)))

    return Shaping


def by_count(loss, reward):
    loss.calls += 1
    return reward / loss.calls


def less_the_mean(loss, reward):
    return reward - loss.mean.mul_(0.9).add_(reward.mean(), alpha=0.1)


def less_a_new_mean(loss, reward):
    loss.mean = 0.9 * loss.mean + 0.1 * reward.mean()
    return reward - loss.mean


def by_the_first(loss, reward):
    if loss.first is None:
        loss.first = reward.mean()
    return reward * (1 + loss.first)


ZERO = torch.zeros(())
ConstantBuffer = shaping(lambda loss, reward: reward * loss.scale, scale=torch.tensor(0.5))
CountingBuffer = shaping(by_count, calls=ZERO)
CountingNumber = shaping(by_count, calls=0)
RunningMean = shaping(less_the_mean, mean=ZERO)
ReplacedMean = shaping(less_a_new_mean, mean=ZERO)
KeepsTheFirst = shaping(by_the_first, first=None)
Noisy = shaping(lambda loss, reward: reward + torch.rand_like(reward))
ReadsAnItem = shaping(lambda loss, reward: 2 * reward if reward.mean().item() > 0.05 else reward)
BatchMean = shaping(lambda loss, reward: reward / (0.1 + reward.mean()))
"""Divides by what would mix lanes that shared a batch."""


class OwnTargets(DQNLoss):
    """Moves its targets itself at each call, in place."""

    def forward(self, batch):
        weights = self.value_network_params.flatten_keys(".")
        for name, target in self.target_value_network_params.flatten_keys(".").items():
            target.data.lerp_(weights[name].detach(), 0.3)
        return super().forward(batch)


class Own(DQN):
    """DQN with a loss of one's own; says nothing of its update."""

    kind = DQNLoss

    def make_loss(self, network):
        options = {"delay_value": True, "loss_function": "l2", "action_space": "categorical"}
        loss = self.kind(QValueActor(network, spec=None, action_space="categorical"), **options)
        loss.make_value_estimator(gamma=self.settings.gamma)
        return loss


class OwnNetwork(Own):
    """The same with a network of one's own, with a layer between two others."""

    layer = nn.Identity

    def make_network(self, spaces):
        return Layers(spaces, self.layer())


class Layers(nn.Module):
    def __init__(self, spaces, between):
        super().__init__()
        self.axes, self.outputs = len(spaces.observation_shape), spaces.actions
        self.first = nn.Linear(torch.Size(spaces.observation_shape).numel(), 12)
        self.between, self.last = between, nn.Linear(12, spaces.actions)

    def forward(self, observation):
        cells = self.first(observation.flatten(-self.axes).float() / 255)
        between = self.between(cells.reshape(-1, 12)).reshape(cells.shape)
        return self.last(between.relu())


def own(kind):
    return type(f"Own{kind.__name__}", (Own,), {"kind": kind})(settings=SETTINGS)


def with_layer(layer):
    return type("OwnLayer", (OwnNetwork,), {"layer": staticmethod(layer)})(settings=SETTINGS)


class OwnSAC(SAC):
    def make_loss(self, network):
        return super().make_loss(network)


class OwnCQL(CQL):
    def make_loss(self, network):
        return super().make_loss(network)


class OwnC51(C51):
    def make_loss(self, network):
        return super().make_loss(network)


DRAWS = {
    "random numbers in the loss": own(Noisy),
    "dropout in the network": with_layer(lambda: nn.Dropout(0.5)),
}
"""What draws from torch's generator, by which lanes would depend on each other."""
LOSSES = {
    "DQNLoss": own(DQNLoss),
    "DiscreteSACLoss": OwnSAC(settings=SETTINGS),
    "DiscreteCQLLoss": OwnCQL(settings=SETTINGS),
    "DistributionalDQNLoss": OwnC51(settings=SETTINGS, atoms=7),
    "a constant buffer": own(ConstantBuffer),
    "a buffer that counts": own(CountingBuffer),
    "a running mean": own(RunningMean),
    "a running mean that is replaced": own(ReplacedMean),
    # Right behind a linear layer it would cancel the layer's bias, whose steps were then of rounding alone.
    "batch norm in the network": with_layer(lambda: nn.Sequential(nn.Tanh(), nn.BatchNorm1d(12))),
    "targets of its own": own(OwnTargets),
    "a number that counts": own(CountingNumber),
    "the first batch's mean": own(KeepsTheFirst),
    "an item": own(ReadsAnItem),
    "the batch's mean": own(BatchMean),
}


def new(algorithm, **lanes):
    """A learner of one agent in each replica."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "agents are updated one after the other")
        return make_learner(
            algorithm,
            GAME.spaces,
            **{"agents": (0,), "replicas": REPLICAS, "seed": 5, "engine": "eager", **lanes},
        )


@pytest.fixture(scope="module")
def turns():
    """Turns of a world of each replica, by chance."""
    env = CommonsEnv(GAME, REPLICAS, seed=3)
    seeds = [(replica, agent) for replica in range(REPLICAS) for agent in range(GAME.agents)]
    actor = LaneActor(None, GAME.spaces.actions, seeds=seeds, agents=GAME.agents)
    moment, came = env.reset(), []
    for _ in range(TURNS):
        with set_exploration_type(ExplorationType.RANDOM):
            action = actor.choose(moment[keys.OBSERVATION])
        turn, moment = env.step_and_maybe_reset(moment.set(keys.ACTION, action))
        came.append(turn.clone())
    assert sum(turn["next", "agents", "reward"].sum() for turn in came) > 0
    return came


def learn(learner, turns):
    for turn in turns:
        learner.store(turn)
        learner.update()
        learner.end_episode(turn["next", "done"][:, 0])
    return learner


def resumed(algorithm, learner):
    """Another learner, with what a checkpoint of the first one keeps."""
    file = BytesIO()
    torch.save(learner.state_dict(), file)
    file.seek(0)
    other = new(algorithm)
    other.load_state_dict(torch.load(file, weights_only=True))
    return other


def weights(learner):
    return {
        f"{name}/{key}": value
        for name, network in learner.networks().items()
        for key, value in network.state_dict().items()
    }


@pytest.mark.integration
@pytest.mark.parametrize("name", LOSSES)
def test_lanes_with_an_own_loss_end_as_those_that_learn_alone_and_as_resumed_ones(name, turns):
    algorithm = LOSSES[name]
    together = weights(learn(new(algorithm), turns))
    parts = weights(learn(resumed(algorithm, learn(new(algorithm), turns[:25])), turns[25:]))
    assert {key: value.tolist() for key, value in together.items()} == {
        key: value.tolist() for key, value in parts.items()
    }
    begun = weights(new(algorithm))
    for replica in range(REPLICAS):
        alone = new(algorithm, replicas=1, first_replica=replica)
        for key, value in weights(learn(alone, [turn[replica : replica + 1] for turn in turns])).items():
            torch.testing.assert_close(together[key], value, rtol=1e-4, atol=5e-5)
    moved = [key for key, value in together.items() if not torch.equal(value, begun[key])]
    assert len(moved) >= len(together) / 2


REASONS = {
    "a buffer that counts": "keeps of a call: calls",
    "a running mean": "keeps of a call: mean",
    "a running mean that is replaced": "keeps of a call: mean",
    "a number that counts": "keeps of a call: calls",
    "the first batch's mean": "keeps of a call: first",
    "an item": r"\.item\(\)",
    "DistributionalDQNLoss": r"\.item\(\)",
}
"""Why agents with such a loss are updated one after the other."""


@pytest.mark.parametrize("name", LOSSES)
def test_the_fastest_update_that_leaves_lanes_alone_is_found_and_the_slow_one_is_warned_of(name):
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        learner = make_learner(LOSSES[name], GAME.spaces, agents=(0,), replicas=2, engine="eager")
    messages = [str(warning.message) for warning in warned]
    # Torch's own, of the loss that moves its targets by lerp_.
    messages = [message for message in messages if "batching rule for aten::lerp_" not in message]
    assert [message for message in messages if "many times slower" in message] == messages
    assert learner.lane_networks.update == ("list" if name in REASONS else "vmapped")
    assert [bool(re.search(REASONS[name], message)) for message in messages] == [True] * (name in REASONS)


@pytest.mark.parametrize("name", DRAWS)
def test_losses_and_networks_that_draw_from_torchs_generator_are_refused(name):
    with pytest.raises(ValueError, match="draws from torch's random generator"):
        new(DRAWS[name])


class QuietPPO(PPO):
    """PPO with a loss of one's own that says nothing of its update."""

    def make_loss(self, network):
        return super().make_loss(network)


class OwnClip(ClipPPOLoss):
    """Halves the loss of the critic."""

    def forward(self, batch):
        out = super().forward(batch)
        return out.set("loss_critic", out["loss_critic"] / 2)


class OwnPPO(PPO):
    def make_loss(self, network):
        return actor_critic_loss(network, OwnClip, loss_critic_type="l2", normalize_advantage=False)


class Normalised(PPO):
    """Lets TorchRL's loss normalise advantages over each minibatch."""

    def make_loss(self, network):
        return actor_critic_loss(network, ClipPPOLoss, loss_critic_type="l2", normalize_advantage=True)


class AskingClip(ClipPPOLoss):
    """Asks for a number in Python."""

    def forward(self, batch):
        assert float(batch["advantage"].sum()) < 1e9
        return super().forward(batch)


class QuietA2C(A2C):
    def make_loss(self, network):
        return super().make_loss(network)


@pytest.mark.parametrize("kind", [QuietPPO, OwnPPO, QuietA2C])
def test_a_loss_derived_from_ppos_that_says_nothing_is_not_updated_lane_by_lane(kind):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        learner = new(kind(settings=ROLLOUTS))
    assert learner.lane_networks.update in ("stacked", "vmapped")


@pytest.mark.parametrize("normalizes", [False, True])
def test_a_loss_of_rollouts_that_asks_for_a_number_is_updated_lane_by_lane_with_one_warning(normalizes):
    options = {"loss_critic_type": "l2", "normalize_advantage": normalizes}
    make_loss = staticmethod(lambda network: actor_critic_loss(network, AskingClip, **options))
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        learner = make_learner(
            type("Asking", (PPO,), {"make_loss": make_loss})(settings=ROLLOUTS),
            GAME.spaces,
            agents=(0,),
            replicas=2,
            engine="eager",
        )
    assert learner.lane_networks.update == "list"
    assert ["many times slower" in str(warning.message) for warning in warned] == [True]


@pytest.mark.integration
@pytest.mark.parametrize("kind", [QuietPPO, OwnPPO, Normalised, QuietA2C])
def test_lanes_of_rollouts_end_as_those_that_learn_alone(kind, turns):
    settings = replace(ROLLOUTS, normalize_advantage=kind is not Normalised)
    algorithm = kind(settings=settings)
    together = weights(learn(new(algorithm), turns))
    for replica in range(REPLICAS):
        alone = new(algorithm, replicas=1, first_replica=replica)
        for key, value in weights(learn(alone, [turn[replica : replica + 1] for turn in turns])).items():
            torch.testing.assert_close(together[key], value, rtol=1e-4, atol=5e-5)


# What is refused of a loss that keeps something, and of one that says its update.


class Norm(nn.Module):
    """A submodule with a number of its own."""

    n = 0


class Stats:
    """An object of one's own."""

    n = 0


def in_submodule(loss):
    loss.norm.n += 1
    return loss.norm.n


def in_object(loss):
    loss.stats[0].n += 1
    return loss.stats[0].n


def in_list(loss):
    loss.seen.append(1.0)
    return len(loss.seen)


def in_array(loss):
    loss.n += 1
    return float(loss.n[0])


def in_dict(loss):
    loss.kept["n"].add_(1)
    return loss.kept["n"]


def in_late_buffer(loss):
    if not hasattr(loss, "late"):
        loss.register_buffer("late", torch.zeros(()))
    return loss.late.add_(1)


def in_growing_buffer(loss):
    loss.grows = torch.cat([loss.grows, torch.ones(1)])
    return loss.grows.sum()


def in_buffer_of_none(loss):
    loss.none = torch.ones(()) if loss.none is None else loss.none + 1
    return loss.none


def in_generator(loss):
    return 1 + loss.rng.random()


KEPT = {
    "norm.n": (in_submodule, {"norm": Norm()}),
    "stats": (in_object, {"stats": [Stats()]}),
    "seen": (in_list, {"seen": []}),
    "n": (in_array, {"n": np.zeros(1)}),
    "kept": (in_dict, {"kept": {"n": ZERO}}),
    "late": (in_late_buffer, {}),
    "grows": (in_growing_buffer, {"grows": torch.zeros(0)}),
    "none": (in_buffer_of_none, {"none": EMPTY}),
    "rng": (in_generator, {"rng": np.random.default_rng(0)}),
}


@pytest.mark.parametrize("update", [None, "list", "stacked"])
@pytest.mark.parametrize("name", KEPT)
def test_a_loss_that_keeps_what_no_checkpoint_has_is_refused_by_its_name(name, update):
    kind = type(own(DQNLoss))
    keep, start = KEPT[name]
    loss = shaping(lambda loss, reward: reward / keep(loss), **start)
    algorithm = type("Keeping", (kind,), {"kind": loss, "update": update})(settings=SETTINGS)
    with pytest.raises(ValueError, match=f"keeps its {name}, a .*, from call to call"):
        new(algorithm)
    with pytest.raises(ValueError, match=f"keeps its {name}, a .*, from call to call"):
        new(algorithm, engine="torchrl")


class Holding(shaping(lambda loss, reward: reward / len(loss.held["names"]))):
    """Holds much that it does not change."""

    def __init__(self, *parts, **options):
        super().__init__(*parts, **options)
        self.register_buffer("mask", torch.tensor([torch.nan, 1.0]))
        self.held = {
            "names": ["a"],
            "sparse": torch.eye(2).to_sparse(),
            "call": self.forward,
            "stats": Stats(),
            "rng": np.random.default_rng(0),
            "of": self,
        }


def test_what_a_loss_holds_and_does_not_change_is_no_matter():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        learner = new(own(Holding))
    assert learner.lane_networks.update == "vmapped"


class ReadsMore(DQNLoss):
    """Reads what no batch has."""

    def forward(self, batch):
        return super().forward(rewarded(batch, lambda reward: reward * batch["weight"]))


@pytest.mark.parametrize("update", ["list", "vmapped", "stacked"])
def test_a_loss_that_says_its_update_is_looked_at_too(update):
    def said(kind):
        return type("Said", (Own,), {"kind": kind, "update": update})(settings=SETTINGS)

    with pytest.raises(ValueError, match="draws from torch's random generator"):
        new(said(Noisy))
    with pytest.raises(ValueError, match=r"the loss reads an entry that its batches do not have: .*weight"):
        new(said(ReadsMore))
    if update == "list":
        assert new(said(CountingNumber)).lane_networks.update == "list"
    else:
        with pytest.raises(ValueError, match=f'update is "{update}", and agents would share .*: calls'):
            new(said(CountingNumber))
    assert new(said(DQNLoss)).lane_networks.update == update


def test_an_algorithm_of_cprl_is_not_looked_at(monkeypatch):
    def look(*given, **options):
        raise AssertionError

    monkeypatch.setattr("cprl.algorithms.base.choose_update", look)
    for kind in (DQN, SAC):
        new(kind(settings=SETTINGS))
    new(PPO(settings=ROLLOUTS))


class Mixing(ClipPPOLoss):
    """Divides by what all transitions of a call have in common."""

    def forward(self, batch):
        out = super().forward(batch)
        return out.set("loss_objective", out["loss_objective"] / (0.1 + batch["advantage"].abs().mean()))


class MixingPPO(PPO):
    loss_kind = Mixing


class FlatDQN(DQN):
    def new_network(self, spaces, outputs, **options):
        return Layers(spaces, nn.Identity())


class ByDefault(DQN):
    """Has another default, and something that DQN does not have."""

    loss_function: str = "smooth_l1"

    def told(self):
        return self.loss_function


class Before(OffPolicy):
    def make_loss(self, network):
        return Own(settings=self.settings).make_loss(network)


class BeforeDQN(Before, DQN):
    pass


class Between(OnPolicy):
    def make_network(self, spaces):
        return super().make_network(spaces)


class WithBetween(PPO, Between):
    pass


@pytest.mark.parametrize(
    ("kind", "word"),
    [
        (DQN, "stacked"),
        (type("Same", (DQN,), {}), "stacked"),
        (Own, None),
        (type("Declaring", (Own,), {"update": "vmapped"}), "vmapped"),
        (MixingPPO, None),
        (FlatDQN, None),
        (type("Drawing", (DQN,), {"stochastic": True}), None),
        (ByDefault, "stacked"),
        (BeforeDQN, None),
        (WithBetween, None),
    ],
)
def test_a_class_that_changes_more_than_defaults_says_its_update_itself(kind, word):
    algorithm = kind(settings=ROLLOUTS if issubclass(kind, PPO) else SETTINGS)
    assert algorithm.declared_update() == word
    assert new(algorithm).lane_networks.update == (word or "vmapped")


def test_the_update_of_a_class_does_not_hold_for_a_network_of_ones_own():
    assert QMIX(settings=SETTINGS).declared_update() == "vmapped"
    assert DQN(settings=SETTINGS, network=Custom("torch.nn:Flatten")).declared_update() is None


class AsksInPython(nn.Module):
    def forward(self, cells):
        return cells * (2 if cells.mean().item() > 1e9 else 1)


def ppo_with(layer):
    def make_network(self, spaces):
        parts = {"actor": Layers(spaces, layer()), "critic": Layers(spaces, layer())}
        parts["critic"].last = nn.Linear(12, 1)
        return AgentNetworks(parts)

    return type("WithLayer", (PPO,), {"make_network": make_network})(settings=ROLLOUTS)


def test_networks_of_rollouts_that_torch_does_not_vmap_are_a_list_and_dropout_is_refused():
    with pytest.warns(RuntimeWarning, match="agents are updated one after the other"):
        learner = make_learner(ppo_with(AsksInPython), GAME.spaces, agents=(0,), engine="eager", replicas=2)
    assert learner.lane_networks.update == "list"
    with pytest.raises(ValueError, match="draws from torch's random generator"):
        new(ppo_with(lambda: nn.Dropout(0.5)))


SEQUENCES = replace(ROLLOUTS, hidden_cells=(32, 32))


@pytest.mark.parametrize("engine", ["eager", "torchrl"])
def test_the_look_at_a_loss_leaves_no_trace(engine):
    learner = new(ppo_with(lambda: nn.BatchNorm1d(12)), engine=engine)
    assert [int(kept) for name, kept in weights(learner).items() if "num_batches" in name] == [0] * REPLICAS
    if engine == "eager":
        kind = type("Recurrent", (PPO,), {"make_loss": lambda self, network: PPO.make_loss(self, network)})
        memory = new(kind(settings=SEQUENCES, network=GRU(recurrent_cells=4))).memory.state_dict()
        assert memory["recurrent"]["ended"].all()
        assert not any(memory["recurrent"][name].any() for name in STATE_NAMES)


@pytest.mark.parametrize(
    "algorithm",
    [
        PPO(settings=ROLLOUTS),
        PPO(settings=replace(ROLLOUTS, only_in_play=True)),
        PPO(settings=SEQUENCES, network=GRU(recurrent_cells=4)),
        IPPO(settings=ROLLOUTS),
        MAPPO(settings=ROLLOUTS),
        IPPO(settings=SEQUENCES, network=GRU(recurrent_cells=4)),
        DQN(settings=SETTINGS),
        DQN(settings=replace(SETTINGS, n_steps=3)),
        DQN(
            settings=replace(SETTINGS, sequence_steps=3, hidden_cells=(32, 32)),
            network=GRU(recurrent_cells=4),
        ),
        MADDPG(settings=SETTINGS),
    ],
    ids=lambda algorithm: type(algorithm).__name__,
)
def test_an_example_has_the_form_of_the_batches_that_are_due(algorithm):
    learner = new(algorithm, agents=(0, 1), reward="team" if isinstance(algorithm, MAPPO) else "individual")
    env = CommonsEnv(GAME, REPLICAS, seed=3)
    moment = env.reset()
    policy = JointPolicy({learner.agents: learner.actor})
    draws = []
    while not draws:
        turn, moment = env.step_and_maybe_reset(policy(moment))
        learner.store(turn)
        draws = list(learner.memory.due(learner.lane_networks))

    def forms(batch):
        entries = batch.flatten_keys("/").items()
        return {name: (entry.shape[2:], entry.dtype) for name, entry in entries}

    example = learner.memory.example(2)
    assert len(example) == 2
    assert forms(example) == forms(draws[0].gather(draws[0].columns))


def test_an_own_loss_is_looked_at_for_two_lanes_however_many_learn(monkeypatch):
    asked, example = [], Replay.example

    def noted(memory, lanes):
        asked.append(lanes)
        return example(memory, lanes)

    monkeypatch.setattr(Replay, "example", noted)
    new(own(DQNLoss), replicas=40)
    assert max(asked) == 2
