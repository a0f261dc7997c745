"""MADDPGLoss: the loss of agents with an actor and a centralised critic each, for discrete actions."""

from dataclasses import dataclass
from typing import ClassVar, Final

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor

from cprl.objectives.td import TDLoss, td_distance

NOISE_NUMBERS: Final = 2
"""The uniform numbers that the loss reads for each transition and member: one samples the member's next
action from its target policy, the other its action in the actor's loss."""


class MADDPGLoss(TDLoss):
    """The loss of MADDPG for discrete actions.

    S agents, the members, each have a policy of their own observations, a critic of the observations and
    actions of all members, and a reward of their own.

    The critic of member i learns r_i + gamma Q'_i(o', a'_1 .. a'_S) by its squared error, where Q' is its
    target and every a'_j, its own too, is sampled from the target policy of member j. The actor of member i
    maximises Q_i(o, a_1 .. a_S), where a_i is sampled from its current policy and the others' actions are
    those of the batch. Samples are one-hot; gradients pass through them as if they were the probabilities
    (straight-through: one_hot + probs - probs.detach()), which is exact if Q_i is linear in a_i. TorchRL's
    `OneHotCategorical(grad_method=ReparamGradientStrategy.PassThrough)` does the same.

    Source: Lowe et al., "Multi-Agent Actor-Critic for Mixed Cooperative-Competitive Environments" (2017).

    Args:
        actor_network: outputs logits, float [.., S, A], those of member i from what member i observes. It
            reads entries that the batch has both at its root and under "next".
        critic_network: outputs values, float [.., S, 1]. It reads such entries and "joint_action", float
            one-hot [.., S, S, A]: row i is the joint action that the critic of member i judges.
        loss_function: the loss of the critics' errors: "l2", "smooth_l1", "l1" or "log_cosh".
        logit_penalty: the weight of the mean squared logit of each member in the actors' loss, 0 or more;
            1e-3 in the published program.
        reduction: "mean" or "sum" over transitions, or "none" for losses [..].

    The discount is 0.99; `make_value_estimator(ValueEstimators.TD0, gamma=0.95)` sets another. It is raised
    to the power "steps_to_next_obs" if the batch has that entry. TorchRL's `SoftUpdate` or `HardUpdate` moves
    the targets.

    `forward` reads the entries of the networks; "action", int64 [.., S]; "noise", float [.., S, 2], uniform
    numbers in 0..1 by which actions are sampled; and under "next" "reward", float [.., S, 1], and "done" and
    "terminated", bool [.., 1] or [.., S, 1]. `set_keys` sets other names. It does not change the batch. It
    returns "loss_actor" and "loss_value", summed over members and then reduced; and, without gradients,
    "entropy" in nats, summed and reduced too, and "pred_value", "target_value" and "td_error", float
    [.., S, 1], the last one squared.
    """

    @dataclass
    class _AcceptedKeys(TDLoss._AcceptedKeys):
        steps_to_next_obs: NestedKey = "steps_to_next_obs"
        noise: NestedKey = "noise"

    default_keys = _AcceptedKeys
    estimated: ClassVar[tuple[str, ...]] = ("reward", "done", "terminated", "steps_to_next_obs")
    out_keys = ("loss_actor", "loss_value", "entropy", "pred_value", "target_value", "td_error")

    actor_network: TensorDictModule
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams
    critic_network: TensorDictModule
    critic_network_params: TensorDictParams
    target_critic_network_params: TensorDictParams

    def __init__(
        self,
        actor_network: TensorDictModule,
        critic_network: TensorDictModule,
        *,
        loss_function: str = "l2",
        logit_penalty: float = 1e-3,
        reduction: str = "mean",
    ) -> None:
        super().__init__()
        self.convert_to_functional(actor_network, "actor_network", create_target_params=True)
        self.convert_to_functional(
            critic_network,
            "critic_network",
            create_target_params=True,
            compare_against=list(actor_network.parameters()),
        )
        self.loss_function = loss_function
        self.logit_penalty = logit_penalty
        self.reduction = reduction

    @property
    def in_keys(self) -> list[NestedKey]:
        """Return the entries that `forward` reads."""
        keys = self.tensor_keys
        network_keys = {*self.actor_network.in_keys, *self.critic_network.in_keys} - {"joint_action"}
        next_keys = {keys.reward, keys.done, keys.terminated, *network_keys}
        all_keys = {keys.action, keys.noise, *network_keys, *(("next", key) for key in next_keys)}
        return sorted(map(unravel_key, all_keys), key=str)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Return the losses of a batch of transitions.

        Raises:
            ValueError: if the batch lacks "noise".
        """
        logits = self.outputs_of("actor_network", self.actor_network_params, tensordict)
        taken = _one_hot(tensordict.get(self.tensor_keys.action), logits)
        next_noise, noise = self._noise(tensordict).unbind(-1)
        target = self._target_value(tensordict, next_noise)
        value = self._values(tensordict, _for_each_member(taken), self.critic_network_params)
        errors = td_distance(value, target, self.loss_function)
        actor_losses = self._actor_losses(tensordict, logits, taken, noise)
        with torch.no_grad():
            entropy = -(logits.softmax(-1) * logits.log_softmax(-1)).sum((-2, -1))
            td_error = (value - target).square()
        sums = {"loss_actor": actor_losses.sum(-1), "loss_value": errors.sum((-2, -1)), "entropy": entropy}
        reduced = {name: self._reduce_loss(entry, tensordict=tensordict) for name, entry in sums.items()}
        values = {"pred_value": value.detach(), "target_value": target, "td_error": td_error}
        return TensorDict({**reduced, **values})

    def _actor_losses(
        self, tensordict: TensorDictBase, logits: Tensor, taken: Tensor, noise: Tensor
    ) -> Tensor:
        """Return the actor's loss of each member, [.., S].

        In row i of the joint actions member i takes an action of its current policy, and the others take
        their actions of the batch.
        """
        is_member = torch.eye(taken.shape[-2], dtype=taken.dtype, device=taken.device).unsqueeze(-1)
        sampled = straight_through(logits, noise)
        joint = is_member * sampled.unsqueeze(-3) + (1 - is_member) * taken.unsqueeze(-3)
        values = self._values(tensordict, joint, self.critic_network_params.detach())
        return self.logit_penalty * logits.square().mean(-1) - values.squeeze(-1)

    def _target_value(self, tensordict: TensorDictBase, noise: Tensor) -> Tensor:
        """Return the targets of the critics, r_i + gamma Q'_i, float [.., S, 1]."""
        keys = self.tensor_keys
        next_entries = tensordict.get("next")
        reward = next_entries.get(keys.reward)
        with torch.no_grad():
            logits = self.outputs_of("actor_network", self.target_actor_network_params, next_entries)
            joint = _for_each_member(sampled_one_hot(logits.softmax(-1), noise))
            value = self._values(next_entries, joint, self.target_critic_network_params)
            transitions = TensorDict({}, tensordict.batch_size)
            names = [("next", name) for name in (keys.reward, keys.done, keys.terminated)]
            for name in map(unravel_key, [*names, keys.steps_to_next_obs]):
                entry = tensordict.get(name, None)
                if entry is not None:
                    transitions.set(name, _expand_to_reward(entry, reward))
            target: Tensor = self.value_estimator.value_estimate(transitions, next_value=value)
        return target

    def _values(self, tensordict: TensorDictBase, joint: Tensor, weights: TensorDictBase) -> Tensor:
        """Return the values of joint actions, [.., S, S, A], by the critics of the members, [.., S, 1]."""
        return self.outputs_of("critic_network", weights, tensordict, joint_action=joint)

    def _noise(self, tensordict: TensorDictBase) -> Tensor:
        """Return the uniform numbers of the batch, float [.., S, 2]."""
        key = self.tensor_keys.noise
        noise: Tensor | None = tensordict.get(key, None)
        if noise is None:
            raise ValueError(
                f'"{key}" is missing; allowed: float [.., members, {NOISE_NUMBERS}] of uniform numbers in '
                "0..1, so that none is drawn from torch's global generator"
            )
        return noise


def straight_through(logits: Tensor, noise: Tensor) -> Tensor:
    """Return one-hot samples of a policy, [.., A], with the gradient of its probabilities."""
    probs = logits.softmax(-1)
    return sampled_one_hot(probs.detach(), noise) + probs - probs.detach()


def sampled_one_hot(probs: Tensor, noise: Tensor) -> Tensor:
    """Return one-hot samples, [.., A], by inverting the cumulative distribution at uniform numbers, [..]."""
    is_passed = noise.unsqueeze(-1) >= probs.cumsum(-1)[..., :-1]
    return _one_hot(is_passed.sum(-1), probs)


def _one_hot(action: Tensor, like: Tensor) -> Tensor:
    """Return actions, int64 [..], as one-hot vectors in the shape and dtype of a tensor [.., A].

    Unlike torch's function this one can be vmapped and compiled.
    """
    return (action.unsqueeze(-1) == torch.arange(like.shape[-1], device=like.device)).to(like.dtype)


def _for_each_member(actions: Tensor) -> Tensor:
    """Expand actions [.., S, A] to joint actions [.., S, S, A], the same for each member."""
    members = actions.shape[-2]
    return actions.unsqueeze(-3).expand(*actions.shape[:-2], members, *actions.shape[-2:])


def _expand_to_reward(entry: Tensor, reward: Tensor) -> Tensor:
    """Expand an entry, [.., 1] of a world or [.., S, 1] of members, to the shape of the rewards."""
    with_members = entry if entry.ndim == reward.ndim else entry.unsqueeze(-2)
    return with_members.expand_as(reward)
