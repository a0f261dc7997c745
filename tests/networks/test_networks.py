"""Which network an agent has: fully connected, convolutional, or one of your own; who acts by which."""

from dataclasses import replace

import pytest
import torch
from c51 import C51
from dqn_parts import KINDS, MEADOW as GAME, changed, make_learner, played, transitions
from network_parts import REPLAY, ROLLOUTS, SPACES, VECTORS
from small_learners import weights
from tensordict import TensorDict
from torch import nn

from cprl import CommonsEnv, Observation, keys
from cprl.algorithms import DQN, MADDPG, MAPPO, SAC
from cprl.algorithms.base import OnPolicy, TeamAlgorithm
from cprl.networks import MLP, Conv, ConvNetwork, MLPNetwork
from cprl.networks.specification import new_network
from cprl.networks.stacked import stack_lanes
from cprl.objectives.functional import mark_targets_updated
from cprl.policies.actors import RandomActor
from cprl.policies.joint_policy import JointPolicy
from cprl.values import Custom

CONV = Conv(channels=(4, 5), hidden_cells=(7,))


class Own(nn.Module):
    """A network of a user's: it reads one leading axis."""

    def __init__(self, spaces, outputs, *, cells=6):
        super().__init__()
        self.layers = nn.Sequential(nn.Flatten(1), nn.LazyLinear(cells), nn.Tanh(), nn.Linear(cells, outputs))

    def forward(self, observation):
        return self.layers(observation.float() / 255)


OWN = Custom("test_networks:Own", {"cells": 5})


@pytest.mark.parametrize("leading", [(), (2,), (2, 3)])
def test_a_convolutional_network_reads_any_leading_axes_of_bytes_and_of_floats(leading):
    network = CONV.make(SPACES, 8)
    seen = torch.randint(256, (*leading, *SPACES.observation_shape), dtype=torch.uint8)
    given = network(seen)
    assert given.shape == (*leading, 8)
    torch.testing.assert_close(network(seen.float()), given)
    one = seen.reshape(-1, *SPACES.observation_shape)[0]
    torch.testing.assert_close(network(one), given.reshape(-1, 8)[0])
    unscaled = replace(SPACES, observation_dtype="float32", observation_scale=1.0)
    floats = CONV.make(unscaled, 8)
    floats.load_state_dict(network.state_dict())
    torch.testing.assert_close(floats(seen.float() / 255), given)


def test_a_convolutional_network_is_the_layers_that_one_would_write_down():
    network = Conv(channels=(4,), kernel_cells=3, hidden_cells=(7,)).make(SPACES, 8, relu_on_outputs=True)
    convolution, first, last = [layer for layer in network.modules() if hasattr(layer, "weight")]
    seen = torch.randint(256, (6, *SPACES.observation_shape), dtype=torch.uint8)
    hidden = nn.functional.conv2d(seen / 255.0, convolution.weight, convolution.bias, padding=1).relu()
    wanted = last(first(hidden.flatten(1)).relu()).relu()
    torch.testing.assert_close(network(seen), wanted)
    assert (network(seen) >= 0).all()


def test_a_fully_connected_network_reads_bytes_as_brightness_in_0_to_1():
    network = MLP(hidden_cells=(6,)).make(SPACES, 7)
    by_hand = network.layers(torch.full((2, 45), 0.2))
    torch.testing.assert_close(network(torch.full((2, 3, 3, 5), 51, dtype=torch.uint8)), by_hand)


@pytest.mark.parametrize("network", [MLP(), CONV])
def test_the_study_as_run_has_relu_on_the_values_and_glorot_weights_with_zero_biases(network):
    made = network.make(SPACES, 8, relu_on_outputs=True, glorot_uniform=True)
    values = made(torch.randint(256, (500, *SPACES.observation_shape), dtype=torch.uint8))
    assert (values >= 0).all()
    assert (values == 0).any()
    for layer in made.modules():
        if isinstance(layer, nn.Linear | nn.Conv2d):
            assert not layer.bias.any()
            fan_in, fan_out = nn.init._calculate_fan_in_and_fan_out(layer.weight)
            limit = (6 / (fan_in + fan_out)) ** 0.5
            assert 0.8 * limit < layer.weight.abs().max() <= limit


def test_without_a_network_the_settings_say_the_hidden_layers():
    for network, cells in ((None, (16, 9)), (MLP(hidden_cells=(16, 9)), (32, 32))):
        made = DQN(settings=replace(REPLAY, hidden_cells=cells), network=network).make_network(SPACES)
        assert isinstance(made, MLPNetwork)
        assert [layer.out_features for layer in made.linears] == [16, 9, 8]
    with pytest.raises(ValueError, match=r"settings.hidden_cells is \(16,\)"):
        DQN(settings=replace(REPLAY, hidden_cells=(16,)), network=CONV).make_network(SPACES)


def learner_of(kind, network, *, spaces=SPACES, **how):
    settings = ROLLOUTS if issubclass(kind, OnPolicy) else REPLAY
    if issubclass(kind, TeamAlgorithm):
        how |= {"reward": "team"}
    algorithm = kind(settings=settings, network=network)
    how = {"agents": (0, 1), "replicas": 2, "engine": "eager", "seed": 4, **how}
    return make_learner(algorithm, spaces, **how)


PLANES = replace(GAME, observation=Observation(scoreboard=True, stock_gauge=True))


@pytest.mark.parametrize(
    ("network", "game"),
    [
        pytest.param(CONV, GAME, id="conv", marks=pytest.mark.integration),
        pytest.param(OWN, GAME, id="own", marks=pytest.mark.integration),
        pytest.param(None, PLANES, id="planes"),
    ],
)
@pytest.mark.parametrize("kind", KINDS)
def test_every_algorithm_learns_with_every_network(kind, network, game):
    if (kind, network) == (C51, OWN):  # torch does not vmap its loss
        with pytest.warns(RuntimeWarning, match="one after the other"):
            assert learner_of(kind, network).lane_networks.update == "list"
        return
    learner = learner_of(kind, network, spaces=game.spaces)
    before = weights(learner)
    assert learner.lane_networks.update != "list", "all lanes at once"
    losses = [loss for loss in played(learner, CommonsEnv(game, 2, seed=3), 24) if loss is not None]
    assert torch.isfinite(torch.stack(losses)).all()
    for name, value in weights(learner).items():
        assert name.endswith("support") or not torch.equal(value, before[name]), name
    seen = torch.randint(256, (5, *game.observation_shape), dtype=torch.uint8)
    assert learner.networks()["replica_1/agent_1"](seen).shape == (5, 8)


@pytest.mark.integration
@pytest.mark.parametrize("network", [CONV, OWN], ids=["conv", "own"])
@pytest.mark.parametrize(
    "kind",
    [
        *(DQN, SAC, MAPPO),
        *(
            pytest.param(kind, marks=pytest.mark.slow)
            for kind in KINDS
            if kind.__name__ in ("C51", "QMIX", "MADDPG", "PPO", "IPPO")
        ),
    ],
)
def test_lanes_learn_with_any_network_what_each_would_alone(kind, network, monkeypatch):
    ends = []
    for is_list in (False, True):
        if is_list:
            monkeypatch.setattr(kind, "declared_update", lambda algorithm: "list")
        learner = learner_of(kind, network)
        assert (learner.lane_networks.update == "list") is is_list
        played(learner, CommonsEnv(GAME, 2, seed=3), 30)
        ends.append(weights(learner))
    torch.testing.assert_close(*ends, rtol=1e-3, atol=1e-5)


def test_a_network_whose_buffers_do_not_stack_is_vmapped():
    class Normalised(Own):
        def __init__(self):
            super().__init__(SPACES, 8)
            self.observation_dims = 3
            self.register_buffer("shift", torch.ones(()))
            self(torch.zeros(1, *SPACES.observation_shape))

        def forward(self, observation):
            return super().forward(observation + self.shift)

    with pytest.raises(ValueError, match="a Normalised has buffers"):
        stack_lanes([Normalised(), Normalised()])
    algorithm = changed(DQN(settings=REPLAY), make_network=lambda spaces: Normalised())
    learner = make_learner(algorithm, SPACES, agents=(0, 1), replicas=1, engine="eager")
    assert learner.lane_networks.update == "vmapped"
    played(learner, CommonsEnv(GAME, 1, seed=3), 24)


@pytest.mark.parametrize("network", [MLP(), CONV, OWN])
def test_the_central_critic_reads_the_observations_of_all_members(network):
    algorithm = MAPPO(settings=ROLLOUTS, network=network)
    team = algorithm.make_team([algorithm.make_network(SPACES) for _ in range(3)], SPACES)
    seen = torch.randint(256, (4, 3, *SPACES.observation_shape), dtype=torch.uint8)
    value = team["critic"](seen)
    assert value.shape == (4, 3, 1)
    other = seen.clone()
    other[:, 2] = 255 - other[:, 2]
    assert (team["critic"](other) != value).all()
    assert torch.equal(team["actor"](other)[:, :2], team["actor"](seen)[:, :2])


class Windows(nn.Linear):
    """Knows the windows of single agents alone."""

    def __init__(self, spaces, outputs):
        channels, rows, cols = spaces.observation_shape
        super().__init__(channels * rows * cols, outputs)

    def forward(self, observation):
        return super().forward(observation.float().flatten(-3))


@pytest.mark.parametrize(("algorithm", "settings"), [(MAPPO, ROLLOUTS), (MADDPG, REPLAY)])
def test_a_network_of_ones_own_that_cannot_be_a_critic_is_named_with_what_a_critic_sees(algorithm, settings):
    team = algorithm(settings=settings, network=Custom("test_networks:Windows"))
    members = [team.make_network(SPACES) for _ in range(2)]
    with pytest.raises(ValueError, match=r"test_networks:Windows of a critic.* members first.*\(2, "):
        team.make_team(members, SPACES)


class Narrow(nn.Module):
    """Gives one output too few."""

    def __init__(self, spaces, outputs):
        super().__init__()
        self.layer = nn.Linear(spaces.observation_shape[-1], outputs - 1)

    def forward(self, observation):
        return self.layer(observation.float().flatten(1)[:, : self.layer.in_features])


def test_what_a_network_cannot_do_is_refused_by_name():
    with pytest.raises(ValueError, match=r"the shape \[6\]"):
        DQN(settings=REPLAY, network=Conv()).make_network(VECTORS)
    assert new_network(MLP(), VECTORS, 3)(torch.zeros(2, 6)).shape == (2, 3)
    for name in ("relu_on_outputs", "glorot_uniform"):
        settings = replace(REPLAY, **{name: True})
        with pytest.raises(ValueError, match=rf"settings.{name} is True; .* test_networks:Own: False"):
            DQN(settings=settings, network=OWN).make_network(SPACES)
        DQN(settings=settings, network=CONV).make_network(SPACES)
    with pytest.raises(
        ValueError, match=r"test_networks:Narrow outputs \[2, 7\] for two .*allowed: \[2, 8\]"
    ):
        DQN(settings=REPLAY, network=Custom("test_networks:Narrow")).make_network(SPACES)
    for target in ("math:hypot", "torch.nn:Linear"):
        with pytest.raises(ValueError, match=target):
            DQN(settings=REPLAY, network=Custom(target)).make_network(SPACES)


def test_networks_are_made_without_hidden_layers_too():
    for network in (MLP(hidden_cells=()), Conv(hidden_cells=())):
        assert network.make(SPACES, 8)(torch.zeros(2, *SPACES.observation_shape)).shape == (2, 8)
    assert isinstance(Conv().make(SPACES, 8), ConvNetwork)


RANGES = [(-5.0, 100.0, 51), (-10.0, 200.0, 51), (0.0, 250.0, 31), (-0.3, 0.0, 7), (1e8, 1e8 + 999, 51)]
RANGES += [(low, high, atoms) for low in (-100, -7, 0) for high in (1, 12.5, 60, 300) for atoms in (11, 101)]


@pytest.mark.parametrize(("lowest", "highest", "atoms"), RANGES)
def test_c51_takes_returns_beyond_its_range_for_its_first_and_last_atom(lowest, highest, atoms):
    algorithm = C51(settings=REPLAY, lowest_return=lowest, highest_return=highest, atoms=atoms)
    network = algorithm.make_network(VECTORS)
    loss = algorithm.make_loss(network)
    mark_targets_updated(loss)
    loss.reduction = "none"
    seen, reward = torch.rand(4, 6), torch.tensor([1e12, -1e12, -1e12, 1e12])[:, None]
    batch = transitions(seen, [0] * 4, seen, reward, [[True]] * 4)
    chances = network.atom_logits(seen)[..., 0].log_softmax(-1)
    atom = torch.tensor([atoms - 1, 0, 0, atoms - 1])
    expected = -chances[torch.arange(4), atom]
    torch.testing.assert_close(loss(batch)["loss"], expected, rtol=1e-4, atol=1e-4)
    assert network.support[[0, -1]].tolist() == pytest.approx([lowest, highest], rel=1e-6, abs=1e-6)


def test_a_random_actor_uses_every_action_and_its_own_seed():
    def actions(seed):
        return RandomActor(5, seed=seed)(TensorDict({}, [4000]))["action"]

    assert torch.equal(actions(1), actions(1))
    assert not torch.equal(actions(1), actions(2))
    assert torch.bincount(actions(1), minlength=5).min() > 700
    state = torch.get_rng_state()
    actions(3)
    assert torch.equal(torch.get_rng_state(), state), "nothing is drawn from torch's global generator"


class Brightest(torch.nn.Module):
    """Acts by the first pixel that it is shown."""

    def forward(self, tensordict):
        return tensordict.set("action", tensordict["observation"][..., 0, 0, 0].long())


def test_each_actor_sees_the_window_of_its_own_agent():
    windows = torch.zeros(3, 2, 3, 4, 5, dtype=torch.uint8)
    windows[:, 0, 0, 0, 0] = torch.tensor([1, 2, 3])
    windows[:, 1, 0, 0, 0] = torch.tensor([4, 5, 6])
    moment = TensorDict({"agents": TensorDict({"observation": windows}, (3, 2))}, (3,))
    chosen = JointPolicy([Brightest(), Brightest()])(moment)[keys.ACTION]
    assert chosen.tolist() == [[1, 4], [2, 5], [3, 6]]
