"""LOLA: members of a team that anticipate how the others learn."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from torch import nn
from torchrl.objectives import LossModule

from cprl.algorithms.base import Coefficient, TeamAlgorithm, TrainingEngine, policy
from cprl.commons.spaces import Spaces
from cprl.learners.lanes import Lanes
from cprl.learners.lola import LOLANetworks, LOLARollouts
from cprl.learners.settings import LOLASettings
from cprl.networks.specification import Network
from cprl.objectives import LOLADiCELoss, LOLALoss
from cprl.values import Custom


@dataclass(frozen=True, kw_only=True)
class LOLA(TeamAlgorithm):
    """Learning with opponent-learning awareness: each member lowers its loss after the naive learning step
    that it expects of the others, which depends on its own policy.

    Members read each other's weights when they learn; they act on their own observations. It is meant for
    members with rewards of their own, `Team(LOLA(...), agents=(0, 1), reward="individual")`. With more than
    two members the terms of all pairs are summed. The losses are `cprl.objectives.LOLALoss` and
    `LOLADiCELoss`. The engine "compiled" compiles only how members act.

    Source: Foerster et al., "Learning with Opponent-Learning Awareness" (2018), and "DiCE: The Infinitely
    Differentiable Monte Carlo Estimator" (2018). Departures from the first:

    1. Advantages by Loaded DiCE replace discounted rewards, with a value network for each member.
    2. A rollout is a piece of one world's play, cut at `rollout_steps`; effects beyond the cut are not
       seen.
    3. Discounts count from the beginning of each piece, and the loss is the mean over pieces.
    4. "policy_gradient" multiplies factors of different rollouts and averages both products.
    5. `entropy_coeff`, 0 by default, adds an entropy term.
    6. Policies step by Adam by default; the step expected of others is plain gradient descent.
    7. "dice" looks one step ahead; the paper has up to three.
    8. Advantages can be normalised.
    9. Critics learn from all rollouts of an update.
    10. Opponents' weights are known; opponent modelling and LOLA that expects LOLA are absent.
    """

    settings: LOLASettings
    estimator: Literal["policy_gradient", "dice"] = "policy_gradient"
    """How the effect of the others' step is estimated: "policy_gradient", to first order, from two rollouts
    by the current weights; "dice", from a further rollout for each member in which the others act by their
    weights after the step. All rollouts are turns of the training itself; evaluations always have the
    current weights."""
    entropy_coeff: Coefficient = 0.0
    """The weight of the policies' entropy in the loss."""
    network: Network | Custom | None = None
    """The architecture of the networks; None for fully connected layers of `settings.hidden_cells`."""
    stochastic = True
    shares_reward = False
    fewest_members = 2
    is_one_lane = False

    def make_network(self, spaces: Spaces) -> nn.Module:
        return self.new_networks(spaces, actor=spaces.actions, critic=1)

    def make_loss(self, network: Any) -> LossModule:
        actors = [policy(networks["actor"]) for networks in network]
        make = LOLADiCELoss if self.estimator == "dice" else LOLALoss
        settings = self.settings
        options = {"look_ahead_rate": settings.look_ahead_rate, "gamma": settings.gamma}
        return make(actors, **options, entropy_coeff=self.entropy_coeff)

    def make_memory(self, lanes: Lanes, network: nn.Module, engine: TrainingEngine) -> Any:
        rollouts = 1 + len(lanes.agents) if self.estimator == "dice" else 2
        return LOLARollouts(lanes, self.settings, network, rollouts=rollouts)

    def make_lane_networks(
        self, networks: Sequence[nn.Module], targets: Any, lanes: Lanes, memory: Any, engine: TrainingEngine
    ) -> Any:
        return LOLANetworks(networks, self.make_loss, self.settings, members=len(lanes.agents))
