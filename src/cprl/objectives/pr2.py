"""PR2Loss: the loss of an agent that values joint actions and expects its peers to answer its own action, for
discrete actions (probabilistic recursive reasoning)."""

from dataclasses import dataclass
from math import log

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictParams
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn

from cprl.objectives.td import TDLoss, td_distance


class PR2Loss(TDLoss):
    """The loss of PR2-Q: an agent learns the values of joint actions, and by them expects its peers' answers.

    The network values pairs of actions, q_j(s, a, b): a is the agent's own action, b that of peer j. The
    value of a joint action is the sum over the peers. With temperature T:

    - the expected answer of peer j is rho(b | s, a) ~ exp(q_j(s, a, b) / T);
    - the value of an own action is Q(s, a) = T log sum exp(Q(s, a, others) / T), over the joint actions of
      the others, see `marginal`;
    - the policy is pi(a | s) ~ exp(Q(s, a) / T).

    The loss is the squared difference between the value of the joint action that was taken and
    r + gamma V(s'), where V is the soft value by the target network, V(s') = T log sum exp(Q(s', a) / T).

    The model of the peers is optimistic: they are expected to do what the agent values, whatever they value.
    In the game of payoffs [[0, 3], [1, 2]] against [[3, 2], [0, 1]], at T = 1, the agent of the rows plays
    (0.676, 0.324), not the equilibrium (0.5, 0.5).

    Source: Wen, Yang, Luo, Wang and Pan, "Probabilistic Recursive Reasoning for Multi-Agent Reinforcement
    Learning" (ICLR 2019), algorithm PR2-Q; `cprl.algorithms.PR2` lists the departures.

    Args:
        value_network: maps observations to the values of pairs, float [..., N - 1, A, A]: a
            `TensorDictModule` with them as its first output, or a module that reads "observation".
        temperature: T, in units of reward, above 0.
        entropy_bonus: whether soft values contain T times the entropy of the joint action, as in the paper.
            That is up to T log A for each agent and step, which rewards agents for each step that they live.
            If False, soft values are lower by N T log A: means replace sums, so that uniform play is worth
            exactly its reward.
        loss_function: the loss of the temporal-difference error: "l2", "smooth_l1" (Huber), "l1" or
            "log_cosh".
        delay_value: whether soft values come from a target network.
        reduction: "none" (one loss per transition), "mean" or "sum".

    `forward` reads the observation; "action", int64 [..., N], the agent's own first; and under "next" the
    observation, "reward" [..., 1], "done" and "terminated". It writes "td_error", the squared error [..., 1].
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
        self.entropy_bonus = entropy_bonus
        self.loss_function = loss_function
        self.reduction = reduction
        self.delay_value = delay_value
        if not isinstance(value_network, TensorDictModule):
            value_network = TensorDictModule(value_network, ["observation"], ["joint_action_value"])
        self.convert_to_functional(value_network, "value_network", create_target_params=delay_value)

    @property
    def in_keys(self) -> list[NestedKey]:
        """Return the entries that `forward` reads."""
        keys = self.tensor_keys
        network_keys = list(self.value_network.in_keys)
        next_keys = [*network_keys, keys.reward, keys.done, keys.terminated]
        return [keys.action, *network_keys, *(unravel_key(("next", key)) for key in next_keys)]

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Return the loss of a batch, under "loss"."""
        keys = self.tensor_keys
        joint = self.outputs_of("value_network", self.value_network_params, tensordict)
        value = chosen_value(joint, tensordict.get(keys.action))
        target = self._target(tensordict)
        tensordict.set(keys.priority, (value.detach() - target).square().unsqueeze(-1))
        loss = td_distance(value, target, self.loss_function)
        return TensorDict({"loss": self._reduce_loss(loss, tensordict=tensordict)})

    def _target(self, tensordict: TensorDictBase) -> Tensor:
        """Return the target r + gamma V(s'), float [...]."""
        with torch.no_grad():
            joint = self.outputs_of("value_network", self.target_value_network_params, tensordict.get("next"))
            next_value = soft_value(marginal(joint, self.temperature), self.temperature)
            if not self.entropy_bonus:
                agents = joint.shape[-3] + 1
                next_value = next_value - self.temperature * agents * log(joint.shape[-1])
            target: Tensor = self.value_estimator.value_estimate(
                tensordict, next_value=next_value.unsqueeze(-1)
            )
        return target.squeeze(-1)


def marginal(joint: Tensor, temperature: float) -> Tensor:
    """Return the values of an agent's own actions, float [..., A]: T log sum exp(Q(s, a, others) / T), summed
    over the joint actions of the others.

    The sum is exact: a joint action is valued by pairs, so the sum over joint actions is a product of the
    sums over each peer's actions. Source: Wen et al., "Probabilistic Recursive Reasoning for Multi-Agent
    Reinforcement Learning" (2019).

    Args:
        joint: the values of pairs, float [..., N - 1, A, A].
        temperature: T.
    """
    return temperature * (joint / temperature).logsumexp(-1).sum(-2)


def chosen_value(joint: Tensor, action: Tensor) -> Tensor:
    """Return the value of one joint action, float [...].

    Args:
        joint: the values of pairs, float [..., N - 1, A, A].
        action: int64 [..., N], the agent's own action first.
    """
    actions = joint.shape[-1]
    own_action = action[..., :1]
    peer_actions = action[..., 1:]
    pair_values = joint.flatten(-2).gather(-1, (own_action * actions + peer_actions).unsqueeze(-1))
    return pair_values.sum((-2, -1))


def soft_value(values: Tensor, temperature: float) -> Tensor:
    """Return the soft value T log sum exp(values / T) over the last axis, from [..., A] to [...]."""
    return temperature * torch.logsumexp(values / temperature, -1)
