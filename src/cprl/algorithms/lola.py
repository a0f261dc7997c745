"""LOLA: members of a team that learn with the others' learning in view."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from torch import nn
from torchrl.objectives import LossModule

from cprl.algorithms.base import TeamAlgorithm, TrainingEngine, Weight, policy
from cprl.commons.spaces import Spaces
from cprl.learners.base import AnyLearner
from cprl.learners.lanes import Lanes
from cprl.learners.learner import Learner
from cprl.learners.lola import LOLANetworks, LOLARollouts
from cprl.learners.settings import LOLASettings
from cprl.networks.specification import Network
from cprl.objectives import LOLADiCELoss, LOLALoss
from cprl.values import Custom


@dataclass(frozen=True, kw_only=True)
class LOLA(TeamAlgorithm):
    """Learning with opponent-learning awareness: each member expects the others to take a naive learning
    step, which depends on what it does, and learns what is good for it after that step.

    Members read each other's weights when they learn; they act on their own observations. Meant for rewards
    of their own, `Team(LOLA(...), agents=(0, 1), reward="individual")`. With more than two members the terms
    of all pairs are summed. Losses: `cprl.objectives.LOLALoss`, `LOLADiCELoss`. The engine "compiled"
    compiles acting alone.

    Source: Foerster et al., "Learning with Opponent-Learning Awareness" (2018), and "DiCE: The Infinitely
    Differentiable Monte Carlo Estimator" (2018); docs/opponents.md lists the departures.
    """

    settings: LOLASettings
    estimator: Literal["policy_gradient", "dice"] = "policy_gradient"
    """How the others' step is judged: "policy_gradient", to first order, from two rollouts of the present
    weights; "dice", by a rollout for each member in which the others act as after their step. All rollouts
    are turns of the training's own episodes; evaluation always has the present weights."""
    entropy_coeff: Weight = 0.0
    network: Network | Custom | None = None
    """The architecture of the networks; None for fully connected layers of `settings.hidden_cells`."""
    settings_kind = LOLASettings
    stochastic = True
    shares_reward = False
    fewest_members = 2

    def make_network(self, spaces: Spaces) -> nn.Module:
        return self.new_networks(spaces, actor=spaces.actions, critic=1)

    def make_loss(self, network: Any) -> LossModule:
        actors = [policy(member["actor"]) for member in network]
        make = LOLADiCELoss if self.estimator == "dice" else LOLALoss
        rate, gamma = self.settings.look_ahead_rate, self.settings.gamma
        return make(actors, look_ahead_rate=rate, gamma=gamma, entropy_coeff=self.entropy_coeff)

    def make_memory(self, lanes: Lanes, network: nn.Module, engine: TrainingEngine) -> Any:
        rollouts = 1 + len(lanes.agents) if self.estimator == "dice" else 2
        return LOLARollouts(lanes, self.settings, network, rollouts=rollouts)

    def make_lane_networks(
        self, networks: Sequence[nn.Module], targets: Any, lanes: Lanes, memory: Any, engine: TrainingEngine
    ) -> Any:
        return LOLANetworks(networks, self.make_loss, self.settings, members=len(lanes.agents))

    def make_learner(self, lanes: Lanes, engine: TrainingEngine = "compiled") -> AnyLearner:
        self.refuse_torchrl(engine)
        self.check_team(len(lanes.agents), lanes.reward)
        return Learner(self, lanes, engine)  # members are lanes of their own
