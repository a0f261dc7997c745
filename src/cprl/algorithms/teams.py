"""Algorithms of teams: agents that learn together, and act each by its own network and what it sees itself.

A team is all the seats of a replica with equal learners; a lane is then a team. VDN, QMIX and MAPPO change
the question: their agents share one reward. MAPPO and IPPO stand in `cprl.algorithms.on_policy_teams`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import ClassVar, Protocol, runtime_checkable

from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import VDNMixer
from torchrl.objectives import LossModule, ValueEstimators
from torchrl.objectives.multiagent import QMixerLoss

from cprl.algorithms.dqn import q_actor, q_network_of
from cprl.commons.game import Game
from cprl.learners.settings import DQNSettings, RolloutSettings
from cprl.learners.transitions import RewardKind
from cprl.networks.agent import AgentNetworks
from cprl.networks.team import Mixing, TeamNetwork

_CHOSEN, _OF_TEAM = "chosen_action_value", "team_value"


@runtime_checkable
class TeamAlgorithm(Protocol):
    """What a team is made of; with `DQNSettings` it learns from replay, with `RolloutSettings` on-policy.

    Equal ones learn as one team in each replica, so it should be a value: a frozen dataclass.
    """

    @property
    def settings(self) -> DQNSettings | RolloutSettings:
        """The hyper-parameters."""

    @property
    def stochastic(self) -> bool:
        """See `cprl.algorithms.dqn.OffPolicy`."""

    @property
    def shares_reward(self) -> bool:
        """Whether its members must be paid for the group."""

    @property
    def fewest_members(self) -> int:
        """With how many the algorithm begins to be one."""

    def network(self, game: Game) -> nn.Module:
        """New networks of one member, which draw their weights from torch's generator; the one that acts
        alone or first in `AgentNetworks`."""

    def team(self, members: Sequence[nn.Module], game: Game) -> nn.Module:
        """Those of all members as `AgentNetworks` of a team, a `TeamNetwork` that acts first; what it adds
        draws its weights from torch's generator."""

    def loss(self, network: nn.Module) -> LossModule:
        """TorchRL's loss over a team's networks, for transitions of the default keys with observations
        [.., S, C, X, Y] and actions [.., S]; rewards [.., 1] of replay, advantages [.., S, 1] of rollouts."""


@dataclass(frozen=True, kw_only=True)
class VDN:
    """Value decomposition: the team's value is the sum of its members', by TorchRL's `QMixerLoss`.

    Source: Sunehag et al., "Value-Decomposition Networks For Cooperative Multi-Agent Learning" (2017).
    """

    settings: DQNSettings
    stochastic: ClassVar[bool] = False
    shares_reward: ClassVar[bool] = True
    fewest_members: ClassVar[int] = 1

    def network(self, game: Game) -> nn.Module:
        """See `TeamAlgorithm`."""
        return q_network_of(game, self.settings)

    def team(self, members: Sequence[nn.Module], game: Game) -> nn.Module:
        """See `TeamAlgorithm`."""
        mixer = VDNMixer(len(members), device="cpu")
        return AgentNetworks({"actor": TeamNetwork(members), "mixer": mixer})  # type: ignore[arg-type]

    def loss(self, network: nn.Module) -> LossModule:
        """See `TeamAlgorithm`."""
        return _mixed(network, [_CHOSEN], self.settings)


@dataclass(frozen=True, kw_only=True)
class QMIX:
    """The team's value grows with each member's, mixed by what all of them see, by TorchRL's `QMixerLoss`.

    Source: Rashid et al., "QMIX: Monotonic Value Function Factorisation for Deep Multi-Agent Reinforcement
    Learning" (2018). Members have networks of their own, of one observation, not recurrent ones.
    """

    settings: DQNSettings
    mixing_cells: int = 32
    """Units of the mixing layer."""
    stochastic: ClassVar[bool] = False
    shares_reward: ClassVar[bool] = True
    fewest_members: ClassVar[int] = 2

    def network(self, game: Game) -> nn.Module:
        """See `TeamAlgorithm`."""
        return q_network_of(game, self.settings)

    def team(self, members: Sequence[nn.Module], game: Game) -> nn.Module:
        """See `TeamAlgorithm`."""
        mixer = Mixing(
            game.observation_shape,
            members=len(members),
            cells=self.mixing_cells,
            highest=game.observation.highest,
        )
        return AgentNetworks({"actor": TeamNetwork(members), "mixer": mixer})  # type: ignore[arg-type]

    def loss(self, network: nn.Module) -> LossModule:
        """See `TeamAlgorithm`."""
        return _mixed(network, [_CHOSEN, "observation"], self.settings)


def check_team(algorithm: TeamAlgorithm, *, reward_kind: RewardKind, members: int) -> None:
    """Raises a ValueError for a team that is none: of members paid for themselves, too few, or with settings
    of the other kind."""
    name, fewest = type(algorithm).__name__, algorithm.fewest_members
    came = algorithm.settings
    wanted = [field.type for field in fields(algorithm) if field.name == "settings"]  # type: ignore[arg-type]
    if not all(isinstance(came, kind) for kind in wanted if isinstance(kind, type)):
        kinds = ", ".join(getattr(kind, "__name__", str(kind)) for kind in wanted)
        raise ValueError(f"{name} has settings of the type {type(came).__name__}; {kinds} is wanted")
    if algorithm.shares_reward and reward_kind != "group":
        raise ValueError(
            f'{name} wants paid="group": its agents share one reward, the sum of all; it came with '
            f'paid="{reward_kind}", for which DQN, PPO or IPPO fit'
        )
    if members < fewest:
        raise ValueError(
            f"{name} wants a team of at least {fewest}: equal learners at so many seats; it came with "
            f"{members}, for which DQN or VDN fits"
        )


def _mixed(network: nn.Module, seen_by_mixer: Sequence[str], settings: DQNSettings) -> LossModule:
    """`QMixerLoss` over a team's "actor" and "mixer", its entries at the root."""
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
