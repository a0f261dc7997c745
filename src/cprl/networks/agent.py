"""Networks made of others: several of one agent, values of joint actions."""

from typing import ClassVar

from torch import Tensor, nn


class AgentNetworks(nn.ModuleDict):
    """Networks of one agent that are trained together, by name; the first one acts."""

    @property
    def stacks_over(self) -> tuple[str, ...]:
        """See `cprl.networks.stacked.stack_lanes`."""
        return tuple(self.keys())

    def forward(self, observation: Tensor) -> Tensor:
        """The output of the acting network."""
        given: Tensor = acting_part(self)(observation)
        return given


def parts_of(network: nn.Module) -> dict[str, nn.Module]:
    """The networks of one agent by name, the acting one first; a single network has the name ""."""
    return dict(network.items()) if isinstance(network, AgentNetworks) else {"": network}


def acting_part(network: nn.Module) -> nn.Module:
    """The network that acts."""
    return next(iter(parts_of(network).values()))


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

    stacks_over: ClassVar = ("network",)

    def __init__(self, network: nn.Module, *, actions: int, peers: int, temperature: float) -> None:
        super().__init__()
        self.network, self.actions, self.peers = network, actions, peers
        self.temperature = temperature

    def joint_values(self, observation: Tensor) -> Tensor:
        """[..., *shape] to the values of pairs, [..., N - 1, A, A]: own action, then that of the peer."""
        return self.network(observation).unflatten(-1, (self.peers, self.actions, self.actions))  # type: ignore[no-any-return]

    def forward(self, observation: Tensor) -> Tensor:
        """[..., *shape] to the logits of the policy, [..., A]."""
        # As `cprl.objectives.pr2.marginal` has it, to the last bit.
        scaled = self.joint_values(observation) / self.temperature
        return self.temperature * scaled.logsumexp(-1).sum(-2) / self.temperature


class OtherOutputs(nn.Module):
    """A network whose outputs are those of another method of it, e.g. "joint_values"; shares its weights."""

    def __init__(self, network: nn.Module, method: str) -> None:
        super().__init__()
        self.of, self._method = network, method

    def forward(self, observation: Tensor) -> Tensor:
        outputs: Tensor = getattr(self.of, self._method)(observation)
        return outputs
