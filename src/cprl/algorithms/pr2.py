"""PR2: agents that learn the values of joint actions and expect their peers to answer."""

from dataclasses import dataclass
from typing import ClassVar, Final

from torch import nn
from torchrl.objectives import LossModule, ValueEstimators

from cprl.algorithms.base import OffPolicy
from cprl.algorithms.dqn import network_of
from cprl.checks import Check, checked, number
from cprl.commons.spaces import Spaces
from cprl.custom import Custom
from cprl.learners.settings import DQNSettings
from cprl.networks.joint import JointNetwork, JointValues
from cprl.networks.specification import Network
from cprl.objectives.log_cosh import DISTANCES
from cprl.objectives.pr2 import PR2Loss

_TEMPERATURE: Final[Check] = number(1e-6, 1e6)


@dataclass(frozen=True, kw_only=True)
class PR2(OffPolicy):
    """Probabilistic recursive reasoning with discrete actions, `cprl.objectives.PR2Loss`.

    The agent learns the values of joint actions from the actions that all agents took, expects its peers to
    answer each of its actions as suits the agent itself, and draws its action from the soft values that
    result. Acting takes its own observation alone. With more than two agents values are sums over pairs of
    the agent and a peer. The peers may learn by anything, or not at all.

    Source: Wen et al., "Probabilistic Recursive Reasoning for Multi-Agent Reinforcement Learning" (2019).
    """

    settings: DQNSettings
    temperature: float = 0.1
    """Of the policy and of the peers' expected answers, in units of reward (apples), 1e-6..1e6."""
    entropy_bonus: bool = True
    """Whether values contain the entropy of the joint action, as in the paper, which pays agents for every
    step that they live; see `PR2Loss`."""
    loss_function: str = "l2"
    """As `DQN.loss_function`."""
    network: Network | Custom | None = None
    """The architecture of the networks; None for fully connected layers of `settings.hidden_cells`."""
    stochastic: ClassVar[bool] = True
    sees_peers_actions: ClassVar[bool] = True
    loss_functions: ClassVar[tuple[str, ...]] = DISTANCES

    def __post_init__(self) -> None:
        checked(f"{type(self).__name__}.temperature", self.temperature, _TEMPERATURE)
        super().__post_init__()

    def make_network(self, spaces: Spaces) -> nn.Module:
        """See `Algorithm`.

        Raises:
            ValueError: for a game of one agent.
        """
        if spaces.agents < 2:
            raise ValueError(
                f"{type(self).__name__} learns from the actions of its peers, and the game has "
                f"{spaces.agents} agent; allowed: games of 2 agents or more; for one agent use DQN or SAC"
            )
        peers, actions = spaces.agents - 1, spaces.actions
        values = network_of(
            spaces,
            self.settings,
            self.network,
            outputs=peers * actions * actions,
            relu_on_outputs=self.settings.relu_on_outputs,
        )
        return JointNetwork(values, actions=actions, peers=peers, temperature=self.temperature)

    def make_loss(self, network: nn.Module) -> LossModule:
        """See `Algorithm`."""
        assert isinstance(network, JointNetwork)
        loss = PR2Loss(
            JointValues(network),
            temperature=self.temperature,
            entropy_bonus=self.entropy_bonus,
            loss_function=self.loss_function,
        )
        loss.make_value_estimator(ValueEstimators.TD0, gamma=self.settings.gamma)
        return loss
