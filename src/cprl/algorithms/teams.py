"""Algorithms of teams: agents that learn together and act independently, on their own observations.

A lane is then a team. VDN, QMIX and MAPPO change the social dilemma: their agents share one reward.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import VDNMixer
from torchrl.objectives import LossModule, ValueEstimators
from torchrl.objectives.multiagent import IPPOLoss, MAPPOLoss, QMixerLoss

from cprl.algorithms.base import OffPolicy, OnPolicy, TeamAlgorithm
from cprl.algorithms.dqn import network_of, q_actor, q_network_of
from cprl.algorithms.on_policy import actor_and_critic, clipped_loss
from cprl.commons.spaces import Spaces
from cprl.custom import Custom
from cprl.learners.settings import DQNSettings, RolloutSettings
from cprl.networks.agent import AgentNetworks
from cprl.networks.specification import Network
from cprl.networks.team import CentralCritic, Mixing, team_network

_CHOSEN, _OF_TEAM = "chosen_action_value", "team_value"


@dataclass(frozen=True, kw_only=True)
class VDN(TeamAlgorithm, OffPolicy):
    """Value decomposition: the team's value is the sum of its members' values, TorchRL's `QMixerLoss`.

    Source: Sunehag et al., "Value-Decomposition Networks For Cooperative Multi-Agent Learning" (2017).
    """

    settings: DQNSettings
    network: Network | Custom | None = None
    """The architecture of the networks; None for fully connected layers of `settings.hidden_cells`."""

    def make_network(self, spaces: Spaces) -> nn.Module:
        """See `Algorithm`."""
        return q_network_of(spaces, self.settings, self.network)

    def make_team(self, members: Sequence[nn.Module], spaces: Spaces) -> nn.Module:
        """See `Algorithm`."""
        mixer = VDNMixer(len(members), device="cpu")
        return AgentNetworks({"actor": _team(members, spaces), "mixer": mixer})

    def make_loss(self, network: nn.Module) -> LossModule:
        """See `Algorithm`."""
        return _mixed(network, [_CHOSEN], self.settings)


@dataclass(frozen=True, kw_only=True)
class QMIX(TeamAlgorithm, OffPolicy):
    """Monotonic mixing: the team's value never falls as a member's value rises. TorchRL's `QMixerLoss`.

    The mixing network reads the observations of all members. Source: Rashid et al., "QMIX: Monotonic Value
    Function Factorisation for Deep Multi-Agent Reinforcement Learning" (2018). Here members share no weights,
    unless `Team.share_parameters` says so, and their networks are not recurrent.
    """

    settings: DQNSettings
    mixing_cells: int = 32
    """Units of the mixing layer."""
    network: Network | Custom | None = None
    """The architecture of the networks; None for fully connected layers of `settings.hidden_cells`."""
    fewest_members: ClassVar[int] = 2

    def make_network(self, spaces: Spaces) -> nn.Module:
        """See `Algorithm`."""
        return q_network_of(spaces, self.settings, self.network)

    def make_team(self, members: Sequence[nn.Module], spaces: Spaces) -> nn.Module:
        """See `Algorithm`."""
        mixer = Mixing(
            spaces.observation_shape,
            members=len(members),
            cells=self.mixing_cells,
            highest=spaces.observation_scale,
        )
        return AgentNetworks({"actor": _team(members, spaces), "mixer": mixer})

    def make_loss(self, network: nn.Module) -> LossModule:
        """See `Algorithm`."""
        return _mixed(network, [_CHOSEN, "observation"], self.settings)


@dataclass(frozen=True, kw_only=True)
class MAPPO(TeamAlgorithm, OnPolicy):
    """PPO with an actor per member and a central critic of all observations, TorchRL's `MAPPOLoss`.

    Source: Yu et al., "The Surprising Effectiveness of PPO in Cooperative Multi-Agent Games" (2022); here
    without value normalisation, and members share no weights, unless `Team.share_parameters` says so.
    """

    settings: RolloutSettings
    clip_epsilon: float = 0.2
    """The largest change of an action's probability, as a ratio minus 1; 1e-6..0.999."""
    entropy_coeff: float = 0.01
    critic_coeff: float = 0.5
    network: Network | Custom | None = None
    """The architecture of the networks; None for fully connected layers of `settings.hidden_cells`."""
    can_be_recurrent: ClassVar[bool] = True

    def make_network(self, spaces: Spaces) -> nn.Module:
        """See `Algorithm`."""
        return network_of(spaces, self.settings, self.network, outputs=spaces.actions)

    def make_team(self, members: Sequence[nn.Module], spaces: Spaces) -> nn.Module:
        """See `Algorithm`."""
        everything = len(members), *spaces.observation_shape
        critic = network_of(spaces, self.settings, self.network, outputs=1, shape=everything)
        return AgentNetworks({"actor": _team(members, spaces), "critic": CentralCritic(critic, len(members))})

    def make_loss(self, network: nn.Module) -> LossModule:
        """See `Algorithm`."""
        return clipped_loss(network, MAPPOLoss, self)


@dataclass(frozen=True, kw_only=True)
class IPPO(TeamAlgorithm, OnPolicy):
    """PPO with an actor and a critic per member, TorchRL's `IPPOLoss`.

    Unlike agents that each learn with `PPO`, members share gradient clipping and the normalisation of
    advantages. Source: de Witt et al., "Is Independent Learning All You Need in the
    StarCraft Multi-Agent Challenge?" (2020).
    """

    settings: RolloutSettings
    clip_epsilon: float = 0.2
    """The largest change of an action's probability, as a ratio minus 1; 1e-6..0.999."""
    entropy_coeff: float = 0.01
    critic_coeff: float = 0.5
    network: Network | Custom | None = None
    """The architecture of the networks; None for fully connected layers of `settings.hidden_cells`."""
    can_be_recurrent: ClassVar[bool] = True
    shares_reward: ClassVar[bool] = False

    def make_network(self, spaces: Spaces) -> nn.Module:
        """See `Algorithm`."""
        return actor_and_critic(spaces, self.settings, self.network)

    def make_team(self, members: Sequence[nn.Module], spaces: Spaces) -> nn.Module:
        """See `Algorithm`."""
        of_each: Sequence[Any] = members
        return AgentNetworks(
            {name: _team([own[name] for own in of_each], spaces) for name in ("actor", "critic")}
        )

    def make_loss(self, network: nn.Module) -> LossModule:
        """See `Algorithm`."""
        return clipped_loss(network, IPPOLoss, self)


def _team(members: Sequence[nn.Module], spaces: Spaces) -> nn.Module:
    return team_network(members, observation_dims=len(spaces.observation_shape))


def _mixed(network: nn.Module, seen_by_mixer: Sequence[str], settings: DQNSettings) -> LossModule:
    """`QMixerLoss` over a team's "actor" and "mixer", with entries at the root of the TensorDict."""
    assert isinstance(network, AgentNetworks)
    loss = QMixerLoss(
        q_actor(network["actor"]),
        TensorDictModule(network["mixer"], list(seen_by_mixer), [_OF_TEAM]),
        delay_value=True,
        action_space="categorical",
    )
    loss.set_keys(action="action", action_value="action_value", local_value=_CHOSEN, global_value=_OF_TEAM)
    loss.make_value_estimator(ValueEstimators.TD0, gamma=settings.gamma)
    return loss
