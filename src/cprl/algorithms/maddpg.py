"""MADDPG: each member has a policy of its own and a critic of what all observe and do."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import prod

from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives import LossModule

from cprl.algorithms.base import OffPolicy, TeamAlgorithm, Weight, team_of
from cprl.commons.spaces import Spaces
from cprl.networks.agent import AgentNetworks
from cprl.networks.mlp import MLP, MLPNetwork
from cprl.networks.specification import Network
from cprl.networks.team import JointCritics, Team
from cprl.objectives.maddpg import NUMBERS, MADDPGLoss
from cprl.objectives.td import DISTANCES
from cprl.values import Custom


@dataclass(frozen=True, kw_only=True)
class MADDPG(TeamAlgorithm, OffPolicy):
    """Multi-agent deep deterministic policy gradient for discrete actions, `cprl.objectives.MADDPGLoss`.

    Each member has a policy of what it observes itself and a critic of what all members observe and do, and
    learns from its own reward: members may cooperate, compete or both. Agents outside the team are part of
    the environment: critics see nothing of them. Members sample their actions from their policies, in
    training and in evaluation.

    Source: Lowe et al., "Multi-Agent Actor-Critic for Mixed Cooperative-Competitive Environments" (2017); how
    this differs is listed in docs/opponents.md.
    """

    logit_penalty: Weight = 1e-3
    """The weight of the mean squared logit in the actors' loss, 0..1e6; 1e-3 in the published program."""
    loss_function: str = "l2"
    """The loss of the critics' temporal-difference errors, as `DQN.loss_function`."""
    network: Network | Custom | None = None
    """As `DQN.network`. The critics' fully connected layers read observations and actions side by side.
    Another network maps the observations of all members to as many features as the last of
    `settings.hidden_cells` has units, and one more layer of that size joins them with the actions."""
    shares_reward = False
    fewest_members = 2
    stochastic = True
    noise_numbers = NUMBERS
    loss_functions = DISTANCES
    update = "stacked"

    def make_network(self, spaces: Spaces) -> nn.Module:
        return self.new_network(spaces, spaces.actions)

    def make_team(self, members: Sequence[nn.Module], spaces: Spaces) -> nn.Module:
        return AgentNetworks(
            {"actor": team_of(members, spaces), "critic": self._critics(len(members), spaces)}
        )

    def _critics(self, members: int, spaces: Spaces) -> JointCritics:
        everything = members, *spaces.observation_shape
        dims, joint = len(everything), members * spaces.actions
        cells, encoders, features = self.settings.hidden_cells, None, prod(everything)
        if isinstance(self.network, MLP):
            cells = self.network.hidden_cells
        elif self.network is not None:
            features, cells = cells[-1], cells[-1:]
            each = [self.new_network(spaces, features, shape=everything) for _ in range(members)]
            encoders = Team(each, observation_dims=dims)
        options = {name: getattr(self.settings, name) for name in ("relu_on_outputs", "glorot_uniform")}
        shape = (features + joint,)
        heads = [MLPNetwork(shape, 1, hidden_cells=cells, highest=1.0, **options) for _ in range(members)]
        return JointCritics(
            Team(heads, observation_dims=1),
            encoders,
            observation_dims=dims - 1,
            highest=spaces.observation_scale,
        )

    def make_loss(self, network: AgentNetworks) -> LossModule:
        loss = MADDPGLoss(
            TensorDictModule(network["actor"], ["observation"], ["logits"]),
            TensorDictModule(network["critic"], ["observation", "joint_action"], ["state_action_value"]),
            loss_function=self.loss_function,
            logit_penalty=self.logit_penalty,
        )
        return self.bootstrapped(loss)
