"""MADDPG: a team whose members learn from rewards of their own, with critics that see the whole team."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import prod
from typing import ClassVar

from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives import LossModule, ValueEstimators

from cprl.algorithms.base import OffPolicy, TeamAlgorithm
from cprl.algorithms.dqn import network_of
from cprl.commons.spaces import Spaces
from cprl.custom import Custom
from cprl.learners.settings import DQNSettings
from cprl.networks.agent import AgentNetworks
from cprl.networks.mlp import MLP, MLPNetwork
from cprl.networks.specification import Network
from cprl.networks.team import JointCritics, team_network
from cprl.objectives.log_cosh import DISTANCES
from cprl.objectives.maddpg import NUMBERS, MADDPGLoss


@dataclass(frozen=True, kw_only=True)
class MADDPG(TeamAlgorithm, OffPolicy):
    """Multi-agent deep deterministic policy gradient for discrete actions, `cprl.objectives.MADDPGLoss`.

    Each member has a policy of what it observes itself and a critic of what all members observe and do, and
    learns from its own reward: members may cooperate, compete or both. Agents outside the team are part of
    the environment: critics see nothing of them. Members sample their actions from their policies, in
    training and in evaluation.

    Source: Lowe et al., "Multi-Agent Actor-Critic for Mixed Cooperative-Competitive Environments" (2017); how
    this differs is listed in docs/algorithms.md.
    """

    settings: DQNSettings
    logit_penalty: float = 1e-3
    """The weight of the mean squared logit in the actors' loss, 0..1e6; 1e-3 in the published program."""
    loss_function: str = "l2"
    """The loss of the critics' temporal-difference errors, as `DQN.loss_function`."""
    network: Network | Custom | None = None
    """The architecture of the networks; None for fully connected layers of `settings.hidden_cells`. The
    critics' fully connected layers read observations and actions side by side. Another network maps the
    observations of all members to as many features as the last of `settings.hidden_cells` has units, and one
    more layer of that size joins them with the actions."""
    shares_reward: ClassVar[bool] = False
    fewest_members: ClassVar[int] = 2
    stochastic: ClassVar[bool] = True
    noise_numbers: ClassVar[int] = NUMBERS
    loss_functions: ClassVar[tuple[str, ...]] = DISTANCES

    def make_network(self, spaces: Spaces) -> nn.Module:
        """See `Algorithm`."""
        return network_of(spaces, self.settings, self.network, outputs=spaces.actions)

    def make_team(self, members: Sequence[nn.Module], spaces: Spaces) -> nn.Module:
        """See `Algorithm`."""
        dims = len(spaces.observation_shape)
        actors = team_network(members, observation_dims=dims)
        return AgentNetworks({"actor": actors, "critic": self._critics(len(members), spaces)})

    def _critics(self, members: int, spaces: Spaces) -> JointCritics:
        everything = members, *spaces.observation_shape
        dims, joint = len(everything), members * spaces.actions
        cells, encoders, features = self.settings.hidden_cells, None, prod(everything)
        if isinstance(self.network, MLP):
            cells = self.network.hidden_cells
        elif self.network is not None:
            features, cells = cells[-1], cells[-1:]
            each = [
                network_of(spaces, self.settings, self.network, outputs=features, shape=everything)
                for _ in range(members)
            ]
            encoders = team_network(each, observation_dims=dims)
        names = "relu_on_outputs", "glorot_uniform"
        how = {name: getattr(self.settings, name) for name in names}
        heads = [
            MLPNetwork((features + joint,), 1, hidden_cells=cells, highest=1.0, **how) for _ in range(members)
        ]
        return JointCritics(
            team_network(heads, observation_dims=1),
            encoders,
            observation_dims=dims - 1,
            highest=spaces.observation_scale,
        )

    def make_loss(self, network: nn.Module) -> LossModule:
        """See `Algorithm`."""
        assert isinstance(network, AgentNetworks)
        loss = MADDPGLoss(
            TensorDictModule(network["actor"], ["observation"], ["logits"]),
            TensorDictModule(network["critic"], ["observation", "joint_action"], ["state_action_value"]),
            loss_function=self.loss_function,
            logit_penalty=self.logit_penalty,
        )
        loss.make_value_estimator(ValueEstimators.TD0, gamma=self.settings.gamma)
        return loss
