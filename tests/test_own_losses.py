"""Losses of a user's own: lanes end as those that learn alone, and what a loss keeps is resumed."""

import warnings
from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
import torch
from c51 import C51
from cql import CQL
from dqn_parts import MEADOW as GAME
from dqn_parts import make_learner
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
    SAC,
    DQNSettings,
    OffPolicy,
    OnPolicy,
    RolloutSettings,
)
from cprl.algorithms.base import actor_critic_loss
from cprl.learners.replay import Replay
from cprl.learners.rollouts import NAMES
from cprl.networks import GRU
from cprl.networks.agent import AgentNetworks
from cprl.policies.assignment import AgentPolicies
from cprl.policies.lanes import LaneActor

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


class ConstantBuffer(DQNLoss):
    """Scales rewards by a buffer that does not change."""

    def __init__(self, *parts, **options):
        super().__init__(*parts, **options)
        self.register_buffer("scale", torch.tensor(0.5))

    def forward(self, batch):
        return super().forward(rewarded(batch, lambda reward: reward * self.scale))


class CountingBuffer(DQNLoss):
    """Anneals by a buffer that counts calls, in place."""

    def __init__(self, *parts, **options):
        super().__init__(*parts, **options)
        self.register_buffer("calls", torch.zeros(()))

    def forward(self, batch):
        self.calls += 1
        out = super().forward(batch)
        return out.set("loss", out["loss"] / self.calls)


class RunningMean(DQNLoss):
    """Centres rewards by a running mean, a buffer that is changed in place."""

    def __init__(self, *parts, **options):
        super().__init__(*parts, **options)
        self.register_buffer("mean", torch.zeros(()))

    def follow(self, mean):
        self.mean.mul_(0.9).add_(mean, alpha=0.1)

    def forward(self, batch):
        self.follow(batch["next", "reward"].detach().mean())
        return super().forward(rewarded(batch, lambda reward: reward - self.mean))


class ReplacedMean(RunningMean):
    """The same, but the buffer is replaced."""

    def follow(self, mean):
        self.mean = 0.9 * self.mean + 0.1 * mean


class Noisy(DQNLoss):
    """Adds noise to rewards by torch's generator."""

    def forward(self, batch):
        return super().forward(rewarded(batch, lambda reward: reward + torch.rand_like(reward)))


class OwnTargets(DQNLoss):
    """Moves its targets itself at each call, in place."""

    def forward(self, batch):
        weights = self.value_network_params.flatten_keys(".")
        for name, target in self.target_value_network_params.flatten_keys(".").items():
            target.data.lerp_(weights[name].detach(), 0.3)
        return super().forward(batch)


class CountingNumber(DQNLoss):
    """Anneals by a Python number that counts calls."""

    def __init__(self, *parts, **options):
        super().__init__(*parts, **options)
        self.calls = 0

    def forward(self, batch):
        self.calls += 1
        out = super().forward(batch)
        return out.set("loss", out["loss"] / self.calls)


class KeepsTheFirst(DQNLoss):
    """Keeps the mean reward of its first batch in an attribute."""

    def __init__(self, *parts, **options):
        super().__init__(*parts, **options)
        self.first = None

    def forward(self, batch):
        if self.first is None:
            self.first = batch["next", "reward"].mean().detach()
        out = super().forward(batch)
        return out.set("loss", out["loss"] * (1 + self.first))


class ReadsAnItem(DQNLoss):
    """Doubles the loss of batches with much reward, by a Python condition."""

    def forward(self, batch):
        out = super().forward(batch)
        return out.set("loss", 2 * out["loss"]) if batch["next", "reward"].mean().item() > 0.05 else out


class BatchMean(DQNLoss):
    """Divides by the mean reward of the batch, which would mix lanes that shared one."""

    def forward(self, batch):
        out = super().forward(batch)
        return out.set("loss", out["loss"] / (0.1 + batch["next", "reward"].mean()))


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
    "batch norm in the network": with_layer(lambda: nn.BatchNorm1d(12)),
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
def test_lanes_with_a_loss_of_ones_own_end_as_those_that_learn_alone(name, turns):
    algorithm = LOSSES[name]
    together = weights(learn(new(algorithm), turns))
    begun = weights(new(algorithm))
    for replica in range(REPLICAS):
        alone = new(algorithm, replicas=1, first_replica=replica)
        for key, value in weights(learn(alone, [turn[replica : replica + 1] for turn in turns])).items():
            torch.testing.assert_close(together[key], value, rtol=1e-4, atol=5e-5)
    moved = [key for key, value in together.items() if not torch.equal(value, begun[key])]
    assert len(moved) >= len(together) / 2


@pytest.mark.integration
@pytest.mark.parametrize("name", LOSSES)
def test_a_training_with_a_loss_of_ones_own_that_is_stopped_and_resumed_equals_a_whole_one(name, turns):
    algorithm = LOSSES[name]
    whole = learn(new(algorithm), turns)
    parts = learn(resumed(algorithm, learn(new(algorithm), turns[:25])), turns[25:])
    assert {key: value.tolist() for key, value in weights(whole).items()} == {
        key: value.tolist() for key, value in weights(parts).items()
    }


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


class QuietA2C(A2C):
    def make_loss(self, network):
        return super().make_loss(network)


@pytest.mark.parametrize("kind", [QuietPPO, OwnPPO, QuietA2C])
def test_a_loss_derived_from_ppos_that_says_nothing_is_not_updated_lane_by_lane(kind):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        learner = new(kind(settings=ROLLOUTS))
    assert learner.lane_networks.update in ("stacked", "vmapped")


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


def dividing(keep, start):
    """A loss that divides rewards by the number of calls, which it keeps as is said."""

    class Dividing(DQNLoss):
        def __init__(self, *parts, **options):
            super().__init__(*parts, **options)
            start(self)

        def forward(self, batch):
            calls = keep(self)
            return super().forward(rewarded(batch, lambda reward: reward / calls))

    return Dividing


def in_submodule(loss):
    loss.norm.n += 1
    return loss.norm.n


def in_object(loss):
    loss.stats[0].n += 1
    return loss.stats[0].n


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
    "norm.n": (in_submodule, lambda loss: loss.add_module("norm", Norm())),
    "stats": (in_object, lambda loss: setattr(loss, "stats", [Stats()])),
    "n": (in_array, lambda loss: setattr(loss, "n", np.zeros(1))),
    "kept": (in_dict, lambda loss: setattr(loss, "kept", {"n": torch.zeros(())})),
    "late": (in_late_buffer, lambda loss: None),
    "grows": (in_growing_buffer, lambda loss: loss.register_buffer("grows", torch.zeros(0))),
    "none": (in_buffer_of_none, lambda loss: loss.register_buffer("none", None)),
    "rng": (in_generator, lambda loss: setattr(loss, "rng", np.random.default_rng(0))),
}


@pytest.mark.parametrize("update", [None, "list", "stacked"])
@pytest.mark.parametrize("name", KEPT)
def test_a_loss_that_keeps_what_no_checkpoint_has_is_refused_by_its_name(name, update):
    kind = type(own(DQNLoss))
    algorithm = type("Keeping", (kind,), {"kind": dividing(*KEPT[name]), "update": update})(settings=SETTINGS)
    with pytest.raises(ValueError, match=f"keeps its {name}, a .*, from call to call"):
        new(algorithm)
    with pytest.raises(ValueError, match=f"keeps its {name}, a .*, from call to call"):
        new(algorithm, engine="torchrl")


def test_what_a_loss_holds_and_does_not_change_is_no_matter():
    def hold(loss):
        loss.register_buffer("mask", torch.tensor([torch.nan, 1.0]))
        loss.held = {
            "names": ["a"],
            "sparse": torch.eye(2).to_sparse(),
            "call": loss.forward,
            "stats": Stats(),
            "rng": np.random.default_rng(0),
            "of": loss,
        }

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        learner = new(own(dividing(lambda loss: len(loss.held["names"]), hold)))
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
    assert algorithm.said_update() == word
    assert new(algorithm).lane_networks.update == (word or "vmapped")


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
        assert not any(memory["recurrent"][name].any() for name in NAMES)


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
    policy = AgentPolicies({learner.agents: learner.actor})
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
