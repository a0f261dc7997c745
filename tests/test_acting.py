"""Networks, actors and seats."""

import pytest
import torch
from tensordict import TensorDict

from cprl import CommonsEnv, keys, presets
from cprl.networks.mlp import MLPNetwork
from cprl.policies.assignment import AgentPolicies
from cprl.policies.lanes import RandomActor


def seen(*worlds):
    return TensorDict({"observation": torch.randint(256, (*worlds, 3, 4, 5), dtype=torch.uint8)}, worlds)


def test_a_network_reads_windows_as_brightness_in_0_to_1():
    network = MLPNetwork((3, 4, 5), 7, hidden_cells=(6,))
    window = torch.full((2, 3, 4, 5), 51, dtype=torch.uint8)
    by_hand = network.layers(torch.full((2, 60), 0.2))
    assert torch.allclose(network(window), by_hand)
    assert network(window).shape == (2, 7)


def test_the_study_as_run_has_relu_on_the_values_and_glorot_weights():
    network = MLPNetwork((3, 4, 5), 7, relu_on_outputs=True, glorot_uniform=True)
    windows = torch.randint(256, (500, 3, 4, 5), dtype=torch.uint8)
    assert (network(windows) >= 0).all()
    assert (network(windows) == 0).any()
    first = network.layers[0]
    assert not first.bias.any()
    bound = (6 / (60 + 32)) ** 0.5
    assert first.weight.abs().max() <= bound
    assert first.weight.abs().max() > 0.95 * bound, "wider than torch's default bound of 0.13"


def test_a_random_actor_uses_every_action_and_its_own_seed():
    def actions(seed):
        return RandomActor(5, seed=seed)(seen(4000))["action"]

    assert torch.equal(actions(1), actions(1))
    assert not torch.equal(actions(1), actions(2))
    assert torch.bincount(actions(1), minlength=5).min() > 700
    told, actor, state = seen(9), RandomActor(5), torch.get_rng_state()
    actor(told)
    assert torch.equal(torch.get_rng_state(), state), "nothing is drawn from torch's global generator"


class Brightest(torch.nn.Module):
    """Acts by the first pixel that it is shown."""

    def forward(self, tensordict):
        return tensordict.set("action", tensordict["observation"][..., 0, 0, 0].long())


def test_each_seat_sees_the_window_of_its_own_agent():
    windows = torch.zeros(3, 2, 3, 4, 5, dtype=torch.uint8)
    windows[:, 0, 0, 0, 0] = torch.tensor([1, 2, 3])
    windows[:, 1, 0, 0, 0] = torch.tensor([4, 5, 6])
    moment = TensorDict({"agents": TensorDict({"observation": windows}, (3, 2))}, (3,))
    chosen = AgentPolicies([Brightest(), Brightest()])(moment)[keys.ACTION]
    assert chosen.tolist() == [[1, 4], [2, 5], [3, 6]]


def test_seats_must_be_as_many_as_agents():
    env = CommonsEnv(presets.game("two_complex"), 3)
    with pytest.raises(ValueError, match="1 actors for 2 agents"):
        AgentPolicies([RandomActor(8)])(env.reset())
