"""Networks made of others: several of one agent, distributions of returns, values of joint actions."""

from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn


class AgentNetworks(nn.ModuleDict):
    """Networks of one agent that are trained together, by name; the first one acts."""

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


class AtomNetwork(nn.Module):
    """The distribution of each action's return over fixed values, called atoms, as in C51.

    Source: Bellemare, Dabney and Munos, "A Distributional Perspective on Reinforcement Learning" (2017).

    Args:
        network: a network with A x atoms outputs.
        lowest: the lowest atom, a return.
        highest: the highest atom; where float32 needs it, see `_support`, it is some float32 steps lower.
    """

    support: Tensor
    stacks_over: ClassVar = ("network",)

    def __init__(
        self, network: nn.Module, *, actions: int, lowest: float, highest: float, atoms: int
    ) -> None:
        super().__init__()
        self.network, self.actions, self.atoms = network, actions, atoms
        self.register_buffer("support", _support(lowest, highest, atoms))

    def atom_logits(self, observation: Tensor) -> Tensor:
        """uint8 [..., C, X, Y] to [..., atoms, A], before the softmax over atoms."""
        return self.network(observation).unflatten(-1, (self.atoms, self.actions))  # type: ignore[no-any-return]

    def forward(self, observation: Tensor) -> Tensor:
        """uint8 [..., C, X, Y] to the expected values [..., A]."""
        return (self.atom_logits(observation).softmax(-2) * self.support[:, None]).sum(-2)


def _support(lowest: float, highest: float, atoms: int) -> Tensor:
    """The atoms, float32 [atoms], such that none is projected beyond the last one.

    `DistributionalDQNLoss` finds the place of a return by dividing its distance to the lowest atom by that
    between atoms. From -5 to 100 the quotient of the highest of 51 is rounded to 50.000004, whose neighbour
    above, 51, is no atom: the loss would write beyond its memory. Quotients of smaller returns are no larger,
    and that of the lowest atom is 0.
    """
    support = torch.linspace(lowest, highest, atoms)
    finest = float(np.spacing(np.float32(max(abs(lowest), abs(highest)))))
    for lower in range(1, atoms):  # where atoms - 1 divides the range, in units of `finest`, all is exact
        if _last_place(support) <= atoms - 1:
            break
        support = torch.linspace(lowest, float(np.float32(highest)) - lower * finest, atoms)
    return support


def _last_place(support: Tensor) -> float:
    """Where `DistributionalDQNLoss` places the highest atom, in its arithmetic."""
    low, high = support.min().item(), support.max().item()
    return float((support.max() - low) / ((high - low) / (len(support) - 1)))


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
