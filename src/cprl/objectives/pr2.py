"""PR2Loss: probabilistic recursive reasoning for discrete actions, an agent's values of joint actions."""

from dataclasses import dataclass
from math import log

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictParams
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn

from cprl.objectives.td import TDLoss, distance


class PR2Loss(TDLoss):
    """The loss of PR2-Q: an agent expects its peers to answer each of its actions, and learns what that pays.

    The network values joint actions by pairs, q_j(s, a, b): the agent's own action and that of peer j; the
    value of a joint action is their sum. With temperature T the peers' expected answer is
    rho(b | s, a) ~ exp(q_j(s, a, b) / T), the value of an own action Q(s, a) = T log sum exp(Q(s, a, others)
    / T) over the others' joint actions, and the policy pi(a | s) ~ exp(Q(s, a) / T); see
    `marginal`. The loss is the squared difference between the value of the joint action taken and
    r + gamma V(s'), where V is the soft value of the target network, T log sum exp(Q(s', a) / T).

    The model of the peers is optimistic: they are expected to do what the agent values, whatever they value.
    In the game of payoffs [[0, 3], [1, 2]] against [[3, 2], [0, 1]], at T = 1, the agent of the rows plays
    (0.676, 0.324), not the equilibrium (0.5, 0.5).

    Source: Wen, Yang, Luo, Wang and Pan, "Probabilistic Recursive Reasoning for Multi-Agent Reinforcement
    Learning" (ICLR 2019), algorithm PR2-Q; departures are numbered in docs/opponents.md.

    Args:
        value_network: maps observations to the values of pairs, float [..., N - 1, A, A]: a
            `TensorDictModule` whose first output they are, or a module that reads "observation".
        temperature: T, in units of reward, above 0.
        entropy_bonus: whether soft values contain T times the entropy of the joint action, as in the paper:
            up to T log A for each agent and step, which pays them for living on. Else the sums are means, by
            which uniform play is worth what it is paid: lower by N T log A.
        loss_function: of the temporal-difference error: "l2", "smooth_l1" (Huber), "l1" or "log_cosh".
        delay_value: whether soft values come from a target network.
        reduction: "none" (one loss per transition), "mean" or "sum".

    Reads the observation, "action" int64 [..., N], the agent's own first, and under "next" the observation,
    "reward" [..., 1], "done" and "terminated"; writes "td_error", the squared error [..., 1].
    """

    @dataclass
    class _AcceptedKeys(TDLoss._AcceptedKeys):
        priority: NestedKey = "td_error"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = ["loss"]  # noqa: RUF012

    value_network: TensorDictModule
    value_network_params: TensorDictParams
    target_value_network_params: TensorDictParams

    def __init__(
        self,
        value_network: TensorDictModule | nn.Module,
        *,
        temperature: float,
        entropy_bonus: bool = True,
        loss_function: str = "l2",
        delay_value: bool = True,
        reduction: str = "mean",
    ) -> None:
        super().__init__()
        self.temperature = temperature
        self.entropy_bonus, self.loss_function, self.reduction = entropy_bonus, loss_function, reduction
        self.delay_value = delay_value
        if not isinstance(value_network, TensorDictModule):
            value_network = TensorDictModule(value_network, ["observation"], ["joint_action_value"])
        self.convert_to_functional(value_network, "value_network", create_target_params=delay_value)

    @property
    def in_keys(self) -> list[NestedKey]:
        """The entries that `forward` reads."""
        keys, seen = self.tensor_keys, list(self.value_network.in_keys)
        after = [*seen, keys.reward, keys.done, keys.terminated]
        return [keys.action, *seen, *(unravel_key(("next", key)) for key in after)]

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """The loss of a batch, under "loss"."""
        keys = self.tensor_keys
        value = chosen(
            self.outputs_of("value_network", self.value_network_params, tensordict),
            tensordict.get(keys.action),
        )
        target = self._target(tensordict)
        tensordict.set(keys.priority, (value.detach() - target).square().unsqueeze(-1))
        loss = distance(value, target, self.loss_function)
        return TensorDict({"loss": self._reduce_loss(loss, tensordict=tensordict)})

    def _target(self, tensordict: TensorDictBase) -> Tensor:
        """r + gamma V(s'), float [...]."""
        with torch.no_grad():
            joint = self.outputs_of("value_network", self.target_value_network_params, tensordict.get("next"))
            following = soft_value(marginal(joint, self.temperature), self.temperature)
            if not self.entropy_bonus:
                agents, actions = joint.shape[-3] + 1, joint.shape[-1]
                following = following - self.temperature * agents * log(actions)
            estimated: Tensor = self.value_estimator.value_estimate(
                tensordict, next_value=following.unsqueeze(-1)
            )
        return estimated.squeeze(-1)


def marginal(joint: Tensor, temperature: float) -> Tensor:
    """Return the value of an agent's own action: T log sum exp(Q(s, a, others) / T) over the joint actions of
    the others.

    Computed exactly: with pairs, float [..., N - 1, A, A], the sum over joint actions is a product of sums
    over each peer's; float [..., A]. The agent expects that a peer answers with rho(b | s, a), which is
    proportional to exp(q(s, a, b) / T): Wen et al., "Probabilistic Recursive Reasoning for Multi-Agent
    Reinforcement Learning" (2019).
    """
    return temperature * (joint / temperature).logsumexp(-1).sum(-2)


def chosen(joint: Tensor, action: Tensor) -> Tensor:
    """Return the value of one joint action.

    Args:
        action: int64 [..., N], the agent's own action first.
    """
    actions = joint.shape[-1]
    action_of_agent = action[..., :1]
    peers = action[..., 1:]
    pairs = joint.flatten(-2).gather(-1, (action_of_agent * actions + peers).unsqueeze(-1))
    return pairs.sum((-2, -1))


def soft_value(values: Tensor, temperature: float) -> Tensor:
    """Return T log sum exp(values / T) over the last axis: [..., A] to [...]."""
    return temperature * torch.logsumexp(values / temperature, -1)
