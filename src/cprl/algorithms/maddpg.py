"""MADDPG: each member has a policy of its own and a critic of what all observe and do."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import prod

from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives import LossModule

from cprl.algorithms.base import Coefficient, OffPolicy, TeamAlgorithm, team_of
from cprl.commons.spaces import Spaces
from cprl.networks.agent import AgentNetworks
from cprl.networks.mlp import MLP, MLPNetwork
from cprl.networks.specification import Network
from cprl.networks.team import JointCritics, TeamNetwork
from cprl.objectives.maddpg import NOISE_NUMBERS, MADDPGLoss
from cprl.objectives.td import Distance
from cprl.values import Custom


@dataclass(frozen=True, kw_only=True)
class MADDPG(TeamAlgorithm, OffPolicy):
    """Multi-agent deep deterministic policy gradient for discrete actions, `cprl.objectives.MADDPGLoss`.

    Each member has a policy of what it observes itself and a critic of what all members observe and do, and
    learns from its own reward: members may cooperate, compete or both. Agents outside the team are part of
    the environment: critics see nothing of them. Members sample their actions from their policies, in
    training and in evaluation.

    Source: Lowe et al., "Multi-Agent Actor-Critic for Mixed Cooperative-Competitive Environments" (2017).
    Departures from it:

    1. The actor's gradient passes straight through a one-hot sample, not a Gumbel-softmax one.
    2. The loss has 0.001 times the mean squared logit (`logit_penalty`), as in the authors' program, not
       in the paper.
    3. Next actions come from stochastic target policies, as in that program.
    4. All members learn from one batch.
    5. Gradients are not clipped.
    6. There are no policy ensembles and no inferred policies.
    7. The defaults are those of `DQNSettings`, not the paper's.
    8. Running out of time does not end the sum of rewards.
    9. Networks that are not fully connected give 32 features, joined with the actions.
    10. With `share_parameters=True` members share the actor, not the critic.
    """

    logit_penalty: Coefficient = 1e-3
    """The weight of the mean squared logit in the actors' loss, 0..1e6; 1e-3 in the published program."""
    loss_function: Distance = "l2"
    """The loss of the critics' temporal-difference errors, see `DQN.loss_function`."""
    network: Network | Custom | None = None
    """The architecture of the networks, see `DQN.network`. Critics of fully connected layers read the
    observations and actions of all members as one vector. In critics of another architecture this network
    maps the observations of all members to features, as many as the last layer of `settings.hidden_cells` has
    units, and one more hidden layer of this size reads features and actions."""
    shares_reward = False
    fewest_members = 2
    stochastic = True
    noise_numbers = NOISE_NUMBERS
    update = "stacked"

    def make_network(self, spaces: Spaces) -> nn.Module:
        return self.new_network(spaces, spaces.actions)

    def make_team(self, members: Sequence[nn.Module], spaces: Spaces) -> nn.Module:
        critics = self._critics(len(members), spaces)
        return AgentNetworks({"actor": team_of(members, spaces), "critic": critics})

    def _critics(self, members: int, spaces: Spaces) -> JointCritics:
        """Return a new critic for each member, of what all members observe and do."""
        everything = members, *spaces.observation_shape
        cells = self.settings.hidden_cells
        encoders = None
        features = prod(everything)
        if isinstance(self.network, MLP):
            cells = self.network.hidden_cells
        elif self.network is not None:
            features = cells[-1]
            cells = cells[-1:]
            each = [self.new_network(spaces, features, shape=everything) for _ in range(members)]
            encoders = TeamNetwork(each, observation_dims=len(everything))
        options = {name: getattr(self.settings, name) for name in ("relu_on_outputs", "glorot_uniform")}
        shape = (features + members * spaces.actions,)
        heads = [MLPNetwork(shape, 1, hidden_cells=cells, highest=1.0, **options) for _ in range(members)]
        return JointCritics(
            TeamNetwork(heads, observation_dims=1),
            encoders,
            observation_dims=len(spaces.observation_shape),
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
