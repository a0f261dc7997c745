"""PR2ActorCritic: PR2 with continuous actions."""

from dataclasses import dataclass
from math import prod
from typing import Any, ClassVar, Final

from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives import LossModule, ValueEstimators

from cprl.algorithms.base import OffPolicy
from cprl.algorithms.pr2 import check_peers, check_temperature
from cprl.learners.settings import DQNSettings
from cprl.networks.agent import AgentNetworks
from cprl.networks.answering import AnswerSampler, JointCritic
from cprl.networks.gaussian import GaussianNetwork, GaussianPolicy
from cprl.networks.mlp import MLPNetwork
from cprl.objectives.pr2_actor_critic import PR2ActorCriticLoss
from cprl.spaces import Spaces

NOISE_SIZE: Final = 1
"""The normal numbers by which the sampler of answers draws one."""
MEAN_RATE: Final = 0.05
SCALE_RATE: Final = 0.1
"""Critic and actor have one learning rate; by these factors the actor is slower, its scale slowest."""


@dataclass(frozen=True, kw_only=True)
class PR2ActorCritic(OffPolicy):
    """Probabilistic recursive reasoning with continuous actions, `cprl.objectives.PR2ActorCriticLoss`.

    The agent has a Gaussian policy, a critic of joint actions, and a sampler of how its peers answer. It acts
    by the mean of its policy, and explores like others with continuous actions, by `epsilon` of the settings
    and `action_noise`; the scale of its policy is wide at first, looks around for it in its critic, and
    narrows as it learns. Its first mean is a uniformly random action.

    Source: Wen et al., "Probabilistic Recursive Reasoning for Multi-Agent Reinforcement Learning" (2019).
    """

    settings: DQNSettings
    temperature: float = 1.0
    """Of the peers' expected answers and of the policy, in units of reward, 1e-6..1e6."""
    first_scale: float = 5.0
    """The standard deviation of the policy at first, in units of actions."""
    value_scale: float = 1.0
    """By which the critic's output is multiplied, in units of reward: the order of magnitude of returns."""
    particles: int = 8
    """Samples of the peers' answers for each transition."""
    action_noise: float = 0.0
    """The standard deviation of the Gaussian noise that exploring agents add to actions."""
    sees_peers_actions: ClassVar[bool] = True
    has_continuous_actions: ClassVar[bool] = True

    def __post_init__(self) -> None:
        check_temperature(self)
        super().__post_init__()

    def noise_numbers_in(self, spaces: Spaces) -> int:
        """See `OffPolicy`."""
        return self.particles * (NOISE_SIZE + spaces.action_size)

    def make_network(self, spaces: Spaces) -> nn.Module:
        """See `Algorithm`.

        Raises:
            ValueError: for a game of one agent.
        """
        check_peers(self, spaces)
        seen, size = prod(spaces.observation_shape), spaces.action_size
        theirs = (spaces.agents - 1) * size
        dims, highest = len(spaces.observation_shape), spaces.observation_scale
        low, high = spaces.action_low, spaces.action_high
        names = "hidden_cells", "glorot_uniform"
        how: dict[str, Any] = {name: getattr(self.settings, name) for name in names}
        actor = GaussianNetwork(
            MLPNetwork(spaces.observation_shape, size, highest=highest, **how),
            low=low,
            high=high,
            scale=self.first_scale,
            mean_rate=MEAN_RATE,
            scale_rate=SCALE_RATE,
        )
        actor.start_anywhere()
        scales: dict[str, Any] = {
            "observation_dims": dims,
            "observation_scale": highest,
            "action_scale": max(abs(low), abs(high)),
        }
        relu = self.settings.relu_on_outputs
        critic = MLPNetwork((seen + size + theirs,), 1, highest=1.0, relu_on_outputs=relu, **how)
        answers = MLPNetwork((seen + size + NOISE_SIZE,), theirs, highest=1.0, **how)
        return AgentNetworks(
            {
                "actor": actor,
                "critic": JointCritic(critic, value_scale=self.value_scale, **scales),
                "conditional": AnswerSampler(answers, **scales),
            }
        )

    def make_loss(self, network: nn.Module) -> LossModule:
        """See `Algorithm`."""
        assert isinstance(network, AgentNetworks)
        actor, critic, conditional = network.values()
        assert isinstance(actor, GaussianNetwork)
        loss = PR2ActorCriticLoss(
            TensorDictModule(GaussianPolicy(actor), ["observation"], ["action", "scale"]),
            critic,
            conditional,
            temperature=self.temperature,
            particles=self.particles,
            noise_size=NOISE_SIZE,
        )
        loss.make_value_estimator(ValueEstimators.TD0, gamma=self.settings.gamma)
        return loss
