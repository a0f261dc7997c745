"""Networks of one agent that are made of other networks: `AgentNetworks`, several that are trained together,
and `JointNetwork`, a policy from the values of joint actions."""

from typing import ClassVar

from torch import Tensor, nn


class AgentNetworks(nn.ModuleDict):
    """The networks of one agent that are trained together, by name, e.g. "actor" and "critic".

    The first one acts: it chooses the agent's actions.
    """

    @property
    def inner_network_names(self) -> tuple[str, ...]:
        """Return the names of the networks, each of which is stacked by itself, see
        `cprl.networks.stacked.stack_lanes`."""
        return tuple(self.keys())

    def forward(self, observation: Tensor) -> Tensor:
        """Return the output of the acting network."""
        return acting_network(self)(observation)


def networks_by_name(network: nn.Module) -> dict[str, nn.Module]:
    """Return the networks of one agent by name, the acting one first; a network that is the agent's only one
    has the name ""."""
    return dict(network.items()) if isinstance(network, AgentNetworks) else {"": network}


def acting_network(network: nn.Module) -> nn.Module:
    """Return the network by which an agent acts, the first of its networks."""
    return next(iter(networks_by_name(network).values()))


class JointNetwork(nn.Module):
    """The policy of an agent that values its own and its peers' actions together.

    The value of a joint action is the sum over the N - 1 peers of a value of the pair, q_j(s, a, b): a the
    agent's own action, b that of peer j. With two agents this leaves joint values free; with more it is an
    assumption, motivated by the pairs of Yang et al., "Mean Field Multi-Agent Reinforcement Learning" (2018).
    Under it the expected answers of peers are independent of each other given the agent's own action, so
    that sums over all joint actions are products of sums over each peer's.

    Args:
        network: a network with (N - 1) x A x A outputs.
        peers: the number of other agents, N - 1.
        temperature: in units of reward, see `cprl.objectives.pr2.marginal`.
    """

    inner_network_names: ClassVar = ("network",)

    def __init__(self, network: nn.Module, *, actions: int, peers: int, temperature: float) -> None:
        super().__init__()
        self.network = network
        self.actions = actions
        self.peers = peers
        self.temperature = temperature

    def joint_values(self, observation: Tensor) -> Tensor:
        """Map observations [..., *shape] to the values of pairs of actions, [..., N - 1, A, A]: the agent's
        own action is the row, the peer's the column."""
        return self.network(observation).unflatten(-1, (self.peers, self.actions, self.actions))

    def forward(self, observation: Tensor) -> Tensor:
        """Map observations [..., *shape] to the logits of the policy, [..., A]."""
        # The same operations in the same order as `cprl.objectives.pr2.marginal`, so equal to the last bit.
        scaled = self.joint_values(observation) / self.temperature
        return self.temperature * scaled.logsumexp(-1).sum(-2) / self.temperature


class MethodModule(nn.Module):
    """A module that calls another method of a network, e.g. "joint_values", and shares its weights."""

    def __init__(self, network: nn.Module, method: str) -> None:
        super().__init__()
        self.of = network  # a part of the weights' names in checkpoints
        self._method = method

    def forward(self, observation: Tensor) -> Tensor:
        return getattr(self.of, self._method)(observation)
