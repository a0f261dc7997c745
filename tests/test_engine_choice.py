"""The engine is found by trial: the fastest that does what each agent would do alone."""

import warnings

import pytest
import torch
from dqn_parts import dqn_learner, dqn_loss
from torch import nn
from torchrl.modules import QValueActor
from torchrl.objectives import DQNLoss, LossModule

from cprl import Game, Rules, maps
from cprl.learners.ring import TransitionForm
from cprl.learners.settings import DQNSettings
from cprl.learners.trial import fitting_engine, trial_batch
from cprl.networks.mlp import MLPNetwork

SHAPE, ACTIONS = (3, 3, 5), 8


class OwnNetwork(nn.Module):
    """A user's."""

    def __init__(self):
        super().__init__()
        self.layers = nn.Sequential(nn.Flatten(-3), nn.Linear(45, 6), nn.Tanh(), nn.Linear(6, ACTIONS))

    def forward(self, observation):
        return self.layers(observation.float() / 255)


class OverAllLanes(DQNLoss):
    """A loss that divides by what all transitions of a call have in common: with a lane axis, all lanes."""

    def forward(self, tensordict):
        out = super().forward(tensordict)
        return out.set("loss", out["loss"] / tensordict["next", "reward"].mean())


class LookingAtNumbers(DQNLoss):
    """A loss that asks for a number in Python, which cannot be vmapped."""

    def forward(self, tensordict):
        out = super().forward(tensordict)
        if float(tensordict["next", "reward"].sum()) < -1:
            return out.set("loss", 2 * out["loss"])
        return out


def loss_of(kind):
    def make(network) -> LossModule:
        actor = QValueActor(network, spec=None, action_space="categorical")
        loss = kind(actor, delay_value=True, loss_function="l2", action_space="categorical")
        loss.make_value_estimator(gamma=0.9)
        return loss

    return make


def engine_of(make_network, make_loss):
    return fitting_engine(
        [make_network() for _ in range(2)],
        make_loss,
        trial_batch(2, TransitionForm(observation_shape=SHAPE), ACTIONS),
    )


def q_network():
    return MLPNetwork(SHAPE, ACTIONS)


@pytest.mark.parametrize(
    ("make_network", "make_loss", "engine"),
    [
        (q_network, lambda network: dqn_loss(network, gamma=0.9), "lane_axis"),
        (OwnNetwork, lambda network: dqn_loss(network, gamma=0.9), "vmapped"),
        (q_network, loss_of(OverAllLanes), "vmapped"),
    ],
    ids=["ours", "own network", "a loss that would mix lanes"],
)
def test_the_fastest_engine_that_fits_is_taken_without_a_word(make_network, make_loss, engine):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert engine_of(make_network, make_loss) == engine


def test_a_loss_that_cannot_be_vmapped_runs_as_a_list_and_a_warning_says_why():
    with pytest.warns(
        RuntimeWarning, match=r"one after the other, which is many times slower; .*vmapped: .*\.item\(\)"
    ):
        assert engine_of(OwnNetwork, loss_of(LookingAtNumbers)) == "list"


def test_a_learner_finds_its_engine():
    game = Game(map=maps.parse(".A>\n..<"), rules=Rules(window_rows=3, window_columns=5))
    how = {"agents": (0, 1), "settings": DQNSettings(buffer_size=50), "compile": False}
    found = dqn_learner(game.spaces, replicas=2, **how)
    named = dqn_learner(game.spaces, replicas=2, engine="lane_axis", **how)
    assert type(found.engine) is type(named.engine)
    assert found.networks().keys() == named.networks().keys()
    for name, network in found.networks().items():
        for mine, theirs in zip(network.parameters(), named.networks()[name].parameters(), strict=True):
            assert torch.equal(mine, theirs), "a trial changes nothing"
