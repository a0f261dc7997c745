"""PR2: Q-learning of joint actions, by an agent that expects its peers to answer it."""

from dataclasses import dataclass
from typing import Annotated

from torch import nn
from torchrl.objectives import LossModule

from cprl.algorithms.base import OffPolicy
from cprl.commons.spaces import Spaces
from cprl.networks.agent import JointNetwork, MethodModule
from cprl.objectives.pr2 import PR2Loss
from cprl.objectives.td import Distance
from cprl.values import Range

Temperature = Annotated[float, Range(1e-6, 1e6)]


@dataclass(frozen=True, kw_only=True)
class PR2(OffPolicy):
    """Probabilistic recursive reasoning with discrete actions, `cprl.objectives.PR2Loss`.

    The agent learns the values of joint actions from the actions that all agents took, expects its peers to
    answer each of its actions as suits the agent itself, and draws its action from the soft values that
    result. Acting takes its own observation alone. With more than two agents values are sums over pairs of
    the agent and a peer. The peers may learn by anything, or not at all.

    Source: Wen et al., "Probabilistic Recursive Reasoning for Multi-Agent Reinforcement Learning" (2019).
    Departures from it:

    1. Actions are discrete, and sums over them are exact.
    2. With more than two agents joint values are sums over pairs.
    3. The temperature is a hyperparameter; the paper's is 1 with scaled rewards.
    4. One network gives policy and conditional.
    5. Next values are the target network's soft values; `entropy_bonus=False` is new.
    6. Agents are updated at the same time, each from its own replay.
    """

    temperature: Temperature = 0.1
    """The temperature of the policy and of the peers' expected answers, in units of reward (apples),
    1e-6..1e6."""
    entropy_bonus: bool = True
    """True if values contain the entropy of the joint action, as in the paper, which pays agents for every
    step that they live; see `PR2Loss`."""
    loss_function: Distance = "l2"
    """The loss of the temporal-difference error, see `DQN.loss_function`."""
    stochastic = True
    sees_peers_actions = True
    update = "stacked"

    def make_network(self, spaces: Spaces) -> nn.Module:
        if spaces.agents < 2:
            raise ValueError(
                f"{type(self).__name__} learns from the actions of its peers, and the game has "
                f"{spaces.agents} agent; allowed: games of 2 agents or more; for one agent use DQN or SAC"
            )
        peers = spaces.agents - 1
        actions = spaces.actions
        relu = self.settings.relu_on_outputs
        values = self.new_network(spaces, peers * actions * actions, relu_on_outputs=relu)
        return JointNetwork(values, actions=actions, peers=peers, temperature=self.temperature)

    def make_loss(self, network: JointNetwork) -> LossModule:
        loss = PR2Loss(
            MethodModule(network, "joint_values"),
            temperature=self.temperature,
            entropy_bonus=self.entropy_bonus,
            loss_function=self.loss_function,
        )
        return self.bootstrapped(loss)
