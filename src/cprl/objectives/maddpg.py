"""MADDPGLoss: actors with centralised critics, for discrete actions."""

from dataclasses import dataclass
from typing import ClassVar, Final

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor

from cprl.objectives.td import TDLoss, distance

NUMBERS: Final = 2
"""Uniform numbers that the loss takes for each transition and member: one samples the member's next action
from its target policy, the other its action for the actor's loss."""


class MADDPGLoss(TDLoss):
    """MADDPG for discrete actions: S agents, the members, each with a policy of its own observations and a
    critic that also sees the observations and actions of all others; each learns from its own reward.

    The critic of member i learns r_i + gamma Q'_i(o', a'_1 .. a'_S) by its squared error, where Q' is its
    target and every a'_j, its own too, is sampled from the target policy of member j. The actor of member i
    maximises Q_i(o, a_1 .. a_S), where a_i is sampled from its current policy and the others' actions are
    those of the batch. Samples are one-hot; gradients pass through them as if they were the probabilities
    (straight-through: one_hot + probs - probs.detach()), which is exact if Q_i is linear in a_i. TorchRL's
    `OneHotCategorical(grad_method=ReparamGradientStrategy.PassThrough)` does the same.

    Source: Lowe et al., "Multi-Agent Actor-Critic for Mixed Cooperative-Competitive Environments" (2017).

    Args:
        actor_network: its output are logits, float [.., S, A], of member i from what member i observes. It
            reads entries that the batch has at its root and under "next".
        critic_network: its output are values, float [.., S, 1], from such entries and "joint_action", float
            one-hot [.., S, S, A]: row i holds the actions of all members by which the critic of member i
            judges.
        loss_function: of the critics' errors: "l2", "smooth_l1", "l1" or "log_cosh".
        logit_penalty: the weight of the mean squared logit of each member in the actors' loss, 0 or more;
            1e-3 in the published program.
        reduction: "mean" or "sum" over transitions, or "none" for losses [..].

    Call `make_value_estimator(ValueEstimators.TD0, gamma=0.95)` for the discount, 0.99 by default; it is
    raised to "steps_to_next_obs" where the batch has that entry. Targets are moved by TorchRL's `SoftUpdate`
    or `HardUpdate`.

    `forward` reads the entries of the networks, "action" int64 [.., S], "noise", float [.., S, 2] of uniform
    numbers in 0..1, which decides what is sampled, and under "next" "reward" float [.., S, 1], "done" and
    "terminated" bool [.., 1] or [.., S, 1]; other names are set by `set_keys`. It writes nothing into the
    batch, and returns, summed over members and then reduced, "loss_actor" and "loss_value", and without
    gradients "entropy", in nats, "pred_value", "target_value" and "td_error", float [.., S, 1], squared.
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
        self.loss_function, self.logit_penalty = loss_function, logit_penalty
        self.reduction = reduction

    @property
    def in_keys(self) -> list[NestedKey]:
        """The entries that `forward` reads."""
        keys = self.tensor_keys
        seen = {*self.actor_network.in_keys, *self.critic_network.in_keys} - {"joint_action"}
        after = {keys.reward, keys.done, keys.terminated, *seen}
        every = {keys.action, keys.noise, *seen, *(("next", key) for key in after)}
        return sorted(map(unravel_key, every), key=str)

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
        errors = distance(value, target, self.loss_function)
        actor_losses = self._actor_losses(tensordict, logits, taken, noise)
        with torch.no_grad():
            entropy = -(logits.softmax(-1) * logits.log_softmax(-1)).sum((-2, -1))
            known = {"pred_value": value.detach(), "target_value": target}
            known["td_error"] = (value - target).square()
        parts = {"loss_actor": actor_losses.sum(-1), "loss_value": errors.sum((-2, -1)), "entropy": entropy}
        reduced = {name: self._reduce_loss(part, tensordict=tensordict) for name, part in parts.items()}
        return TensorDict({**reduced, **known})

    def _actor_losses(
        self, tensordict: TensorDictBase, logits: Tensor, taken: Tensor, noise: Tensor
    ) -> Tensor:
        """Of each member, [.., S]: in row i of the joint actions member i takes an action of its current
        policy, the others those of the batch."""
        of_member = torch.eye(taken.shape[-2], dtype=taken.dtype, device=taken.device).unsqueeze(-1)
        sampled = straight_through(logits, noise)
        joint = of_member * sampled.unsqueeze(-3) + (1 - of_member) * taken.unsqueeze(-3)
        values = self._values(tensordict, joint, self.critic_network_params.detach())
        return self.logit_penalty * logits.square().mean(-1) - values.squeeze(-1)

    def _target_value(self, tensordict: TensorDictBase, noise: Tensor) -> Tensor:
        """What the critics learn, float [.., S, 1]."""
        keys, after = self.tensor_keys, tensordict.get("next")
        reward = after.get(keys.reward)
        with torch.no_grad():
            logits = self.outputs_of("actor_network", self.target_actor_network_params, after)
            joint = _for_each_member(sampled_one_hot(logits.softmax(-1), noise))
            value = self._values(after, joint, self.target_critic_network_params)
            entries = {
                ("next", keys.reward): reward,
                ("next", keys.done): _as(after.get(keys.done), reward),
                ("next", keys.terminated): _as(after.get(keys.terminated), reward),
            }
            steps = tensordict.get(keys.steps_to_next_obs, None)
            if steps is not None:
                entries[keys.steps_to_next_obs] = _as(steps, reward)
            transitions = TensorDict({}, tensordict.batch_size)
            for name, entry in entries.items():
                transitions.set(unravel_key(name), entry)
            target: Tensor = self.value_estimator.value_estimate(transitions, next_value=value)
        return target

    def _values(self, tensordict: TensorDictBase, joint: Tensor, weights: TensorDictBase) -> Tensor:
        """Of joint actions [.., S, S, A] by the critic of each member, [.., S, 1]."""
        return self.outputs_of("critic_network", weights, tensordict, joint_action=joint)

    def _noise(self, tensordict: TensorDictBase) -> Tensor:
        """Return the uniform numbers of the batch, float [.., S, 2]."""
        key = self.tensor_keys.noise
        noise: Tensor | None = tensordict.get(key, None)
        if noise is None:
            raise ValueError(
                f'"{key}" is missing; allowed: float [.., members, {NUMBERS}] of uniform numbers in 0..1, so '
                "that none is drawn from torch's global generator"
            )
        return noise


def straight_through(logits: Tensor, noise: Tensor) -> Tensor:
    """One-hot samples of a policy, [.., A], with the gradient of its probabilities."""
    probs = logits.softmax(-1)
    return sampled_one_hot(probs.detach(), noise) + probs - probs.detach()


def sampled_one_hot(probs: Tensor, noise: Tensor) -> Tensor:
    """One-hot samples [.., A] by inverting the cumulative distribution at uniform numbers."""
    below = noise.unsqueeze(-1) >= probs.cumsum(-1)[..., :-1]
    return _one_hot(below.sum(-1), probs)


def _one_hot(action: Tensor, like: Tensor) -> Tensor:
    """Actions int64 [..] as one-hot in the type of a tensor [.., A]; unlike torch's, it can be vmapped and
    compiled."""
    return (action.unsqueeze(-1) == torch.arange(like.shape[-1], device=like.device)).to(like.dtype)


def _for_each_member(actions: Tensor) -> Tensor:
    """Actions [.., S, A] as joint actions [.., S, S, A], the same for each member."""
    members = actions.shape[-2]
    return actions.unsqueeze(-3).expand(*actions.shape[:-2], members, *actions.shape[-2:])


def _as(flag: Tensor, reward: Tensor) -> Tensor:
    """An entry [.., 1] of a world, or [.., S, 1] of members, for each member."""
    return (flag if flag.ndim == reward.ndim else flag.unsqueeze(-2)).expand_as(reward)
