"""Networks of joint action values, and what an agent makes of them that expects its peers to answer."""

import torch
from torch import Tensor, nn


class JointNetwork(nn.Module):
    """The policy of an agent that values its own and its peers' actions together.

    The value of a joint action is the sum over the N - 1 peers of a value of the pair, q_j(s, a, b): a the
    agent's own action, b that of peer j. With two agents this leaves joint values free; with more it is an
    assumption, motivated by the pairs of Yang et al., "Mean Field Multi-Agent Reinforcement Learning" (2018).
    Under it the expected answers of peers are independent of each other given the agent's own action, so
    that sums over all joint actions are products of sums over each peer's.

    Args:
        network: a network with (N - 1) x A x A outputs.
        actions: the number of actions A.
        peers: the number of other agents, N - 1.
        temperature: in units of reward, see `marginal`.
    """

    def __init__(self, network: nn.Module, *, actions: int, peers: int, temperature: float) -> None:
        super().__init__()
        self.network, self.actions, self.peers = network, actions, peers
        self.temperature = temperature

    def joint_values(self, observation: Tensor) -> Tensor:
        """[..., *shape] to the values of pairs, [..., N - 1, A, A]: own action, then that of the peer."""
        return self.network(observation).unflatten(-1, (self.peers, self.actions, self.actions))  # type: ignore[no-any-return]

    def forward(self, observation: Tensor) -> Tensor:
        """[..., *shape] to the logits of the policy, [..., A]."""
        return marginal(self.joint_values(observation), self.temperature) / self.temperature


class JointValues(nn.Module):
    """A `JointNetwork` whose output is the values of pairs, [..., N - 1, A, A].

    Args:
        network: the network, whose weights it shares.
    """

    def __init__(self, network: JointNetwork) -> None:
        super().__init__()
        self.of = network

    def forward(self, observation: Tensor) -> Tensor:
        """The values."""
        return self.of.joint_values(observation)


def conditional(joint: Tensor, temperature: float) -> Tensor:
    """What an agent expects of each peer after each action of its own: rho(b | s, a) ~ exp(q(s, a, b) / T).

    Source: Wen et al., "Probabilistic Recursive Reasoning for Multi-Agent Reinforcement Learning" (2019).

    Args:
        joint: values of pairs, float [..., N - 1, A, A].
        temperature: T, in units of reward.

    Returns:
        Probabilities [..., N - 1, A, A], which sum to 1 over the last axis, the peer's action.
    """
    return (joint / temperature).softmax(-1)


def marginal(joint: Tensor, temperature: float) -> Tensor:
    """The value of an agent's own action: T log sum exp(Q(s, a, others) / T) over the others' joint actions.

    Computed exactly: with pairs the sum over joint actions is a product of sums over each peer's. Same source
    and arguments as `conditional`; float [..., A].
    """
    return temperature * (joint / temperature).logsumexp(-1).sum(-2)


def chosen(joint: Tensor, action: Tensor) -> Tensor:
    """The value of one joint action.

    Args:
        joint: values of pairs, float [..., N - 1, A, A].
        action: int64 [..., N], the agent's own action first.

    Returns:
        Float [...].
    """
    actions = joint.shape[-1]
    own, peers = action[..., :1], action[..., 1:]
    pairs = joint.flatten(-2).gather(-1, (own * actions + peers).unsqueeze(-1))
    return pairs.sum((-2, -1))


def soft_value(values: Tensor, temperature: float) -> Tensor:
    """T log sum exp(values / T) over the last axis: [..., A] to [...]."""
    return temperature * torch.logsumexp(values / temperature, -1)
