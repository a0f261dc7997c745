"""PR2ActorCriticLoss: probabilistic recursive reasoning for continuous actions."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import sqrt
from typing import Any, Final

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictParams
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn

from cprl.checks import checked, count, instance, number, one_of
from cprl.objectives.stein import stein_direction
from cprl.objectives.td_loss import TDLoss

_NO_CERTAINTY: Final = 1e-6
"""Uniform numbers this close to 0 or 1 are moved inwards, where the normal quantile is finite."""


class PR2ActorCriticLoss(TDLoss):
    """The losses of PR2-AC: an actor that ascends what its actions pay once the peers have answered them.

    - The conditional, a sampler b = g(s, a, noise) of the peers' answer to the agent's action a, moves by the
      amortised Stein variational gradient towards rho(b | s, a) ~ exp((Q(s, a, b) - Q(s, a)) / T).
    - The critic learns Q(s, a, b) of the joint action taken, by the squared error against
      r + gamma Q'(s', a', b'): a' of the target actor, b' of the target conditional, their mean over samples.
    - The actor ascends the mean of Q(s, a, g(s, a, noise)) over the noise, through the answers too: it takes
      into account how peers answer where it goes.

    The actor is deterministic; where its network writes "scale" too, it is Gaussian with this standard
    deviation. It then ascends the mean over its actions, plus T times the logarithm of the scale, its
    entropy up to a constant: of all Gaussian policies it approaches that nearest to exp(Q(s, a) / T).

    Sources: Wen, Yang, Luo, Wang and Pan, "Probabilistic Recursive Reasoning for Multi-Agent Reinforcement
    Learning" (ICLR 2019), algorithm PR2-AC; the sampler: Feng, Wang and Liu, "Learning to Draw Samples with
    Amortized Stein Variational Gradient Descent" (2017). Departures are numbered in docs/algorithms.md.

    Args:
        actor_network: the agent's action float [..., D] of its observation: a `TensorDictModule` that writes
            "action", and if it likes "scale", float [..., D], or a module that reads "observation".
        value_network: the joint value [..., 1] of "observation", "action" [..., D] and "peers_action"
            [..., (N - 1) x D]: likewise; it writes "state_action_value".
        conditional_network: the answer [..., (N - 1) x D] to "observation", "action" and "noise" [..., Z];
            likewise; it writes "peers_action".
        temperature: T, in units of reward; a buffer of that name, which may be changed.
        particles: samples M of the conditional, at least 2.
        noise_size: Z.
        reduction: "none" (one loss per transition), "mean" or "sum".

    Reads the observation, "action" float [..., N, D], the agent's own first, and under "next" the
    observation, "reward" [..., 1], "done" and "terminated"; and "noise", uniform numbers in 0..1, float
    [..., K] with K = `noise_numbers(D)`, if the batch has it, else numbers from torch's generator. Returns
    "loss_qvalue", "loss_actor", whose value is the negative mean of Q, and "loss_conditional", of which the
    gradient alone has a meaning.

    Raises:
        ValueError: if an argument is not allowed; names it and says what is.
    """

    @dataclass
    class _AcceptedKeys:
        """The entries by the names that `set_keys` takes."""

        action: NestedKey = "action"
        scale: NestedKey = "scale"
        peers_action: NestedKey = "peers_action"
        state_action_value: NestedKey = "state_action_value"
        noise: NestedKey = "noise"
        value_target: NestedKey = "value_target"
        reward: NestedKey = "reward"
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = ("loss_qvalue", "loss_actor", "loss_conditional")

    actor_network: TensorDictModule
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams
    value_network: TensorDictModule
    value_network_params: TensorDictParams
    target_value_network_params: TensorDictParams
    conditional_network: TensorDictModule
    conditional_network_params: TensorDictParams
    target_conditional_network_params: TensorDictParams
    temperature: Tensor

    def __init__(
        self,
        actor_network: TensorDictModule | nn.Module,
        value_network: TensorDictModule | nn.Module,
        conditional_network: TensorDictModule | nn.Module,
        *,
        temperature: float,
        particles: int = 16,
        noise_size: int = 1,
        reduction: str = "mean",
    ) -> None:
        super().__init__()
        self._in_keys: list[NestedKey] | None = None
        seen, action, peers = "observation", "action", "peers_action"
        forms = {
            "actor_network": (actor_network, [seen], [action]),
            "value_network": (value_network, [seen, action, peers], ["state_action_value"]),
            "conditional_network": (conditional_network, [seen, action, "noise"], [peers]),
        }
        for name, (network, reads, writes) in forms.items():
            checked(name, network, instance(nn.Module, "a TensorDictModule or a torch.nn.Module"))
            if not isinstance(network, TensorDictModule):
                network = TensorDictModule(network, reads, writes)
            self.convert_to_functional(network, name, create_target_params=True)
        checked("temperature", temperature, number(1e-6, 1e6))
        self.register_buffer("temperature", torch.tensor(float(temperature)))
        self.particles = checked("particles", particles, count(2))
        self.noise_size = checked("noise_size", noise_size, count(1))
        self.reduction = checked("reduction", reduction, one_of("none", "mean", "sum"))

    @property
    def in_keys(self) -> list[NestedKey]:
        """The entries that the loss reads."""
        if self._in_keys is None:
            keys = self.tensor_keys
            seen = list(self.actor_network.in_keys)
            after = (("next", key) for key in (*seen, keys.reward, keys.done, keys.terminated))
            self._in_keys = [unravel_key(key) for key in (keys.action, *seen, *after)]
        return self._in_keys

    @in_keys.setter
    def in_keys(self, keys: list[NestedKey]) -> None:
        self._in_keys = keys

    def _estimator_keys(self) -> dict[str, NestedKey]:
        keys = self.tensor_keys
        names = "value_target", "reward", "done", "terminated"
        return {"value": keys.state_action_value, **{name: getattr(keys, name) for name in names}}

    def noise_numbers(self, action_size: int) -> int:
        """The uniform numbers that it takes for a transition, where an action has D numbers."""
        return int(self.particles * (self.noise_size + action_size))

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """The losses of a batch."""
        joint: Tensor = tensordict.get(self.tensor_keys.action)
        own, peers = joint[..., 0, :], joint[..., 1:, :].flatten(-2)
        seen = tensordict.select(*self.actor_network.in_keys)
        noise, around = self._noise(tensordict, own)
        error = self._value(self.value_network_params, seen, own, peers) - self._target(tensordict, noise)
        losses = {
            "loss_qvalue": error.square(),
            "loss_actor": self._actor_loss(seen, noise, around),
            "loss_conditional": self._conditional_loss(seen, own, noise),
        }
        reduced = {name: self._reduce_loss(loss, tensordict=tensordict) for name, loss in losses.items()}
        return TensorDict(reduced)

    def _actor_loss(self, seen: TensorDictBase, noise: Tensor, around: Tensor) -> Tensor:
        """The negative mean over samples of the values of the actor's actions and their answers, with the
        entropy of a Gaussian actor, [...]."""
        written = self._called("actor_network", self.actor_network_params, seen)
        action, scale = (written.get(key, None) for key in (self.tensor_keys.action, self.tensor_keys.scale))
        actions, entropy = action.unsqueeze(-2).expand_as(around), 0.0
        if scale is not None:
            actions = actions + scale.unsqueeze(-2) * around
            entropy = self.temperature * scale.log().sum(-1)
        seen = self._repeated(seen)
        answers = self._answers(self.conditional_network_params.detach(), seen, actions, noise)
        values = self._value(self.value_network_params.detach(), seen, actions, answers)
        return -(values.mean(-1) + entropy)

    def _conditional_loss(self, seen: TensorDictBase, own: Tensor, noise: Tensor) -> Tensor:
        """A sum whose gradient for the samples is the negative Stein direction, [...]."""
        seen, own = self._repeated(seen), own.unsqueeze(-2).expand(*own.shape[:-1], self.particles, -1)
        answers = self._answers(self.conditional_network_params, seen, own, noise)
        weights = self.value_network_params.detach()

        def values(peers: Tensor) -> Tensor:
            return self._value(weights, seen, own, peers).sum()

        score = torch.func.grad(values)(answers.detach()) / self.temperature
        direction = stein_direction(answers.detach(), score.detach())
        return -(direction * answers).sum(-1).mean(-1)

    def _target(self, tensordict: TensorDictBase, noise: Tensor) -> Tensor:
        """r + gamma Q'(s', a', b'), the mean over the answers b' of the target conditional, [...]."""
        with torch.no_grad():
            seen = tensordict.get("next").select(*self.actor_network.in_keys)
            written = self._called("actor_network", self.target_actor_network_params, seen)
            action = written.get(self.tensor_keys.action)
            seen, actions = self._repeated(seen), action.unsqueeze(-2)
            actions = actions.expand(*action.shape[:-1], self.particles, -1)
            answers = self._answers(self.target_conditional_network_params, seen, actions, noise)
            following = self._value(self.target_value_network_params, seen, actions, answers).mean(-1)
            target: Tensor = self.value_estimator.value_estimate(
                tensordict, next_value=following.unsqueeze(-1)
            )
        return target.squeeze(-1)

    def _noise(self, tensordict: TensorDictBase, own: Tensor) -> tuple[Tensor, Tensor]:
        """Standard normal numbers of the conditional, [..., M, Z], and of the actor, [..., M, D]."""
        size, uniform = own.shape[-1], tensordict.get(self.tensor_keys.noise, None)
        shape = *tensordict.batch_size, self.noise_numbers(size)
        uniform = torch.rand(shape, device=own.device) if uniform is None else uniform.reshape(shape)
        certain = uniform.clamp(_NO_CERTAINTY, 1 - _NO_CERTAINTY).to(own.dtype)
        normal = sqrt(2) * torch.erfinv(2 * certain - 1)
        by_particle = normal.view(*shape[:-1], self.particles, self.noise_size + size)
        return by_particle[..., : self.noise_size], by_particle[..., self.noise_size :]

    def _repeated(self, seen: TensorDictBase) -> TensorDictBase:
        """What is seen, for each particle: from [...] to [..., M]."""
        size = seen.batch_size
        return seen.unsqueeze(len(size)).expand(*size, self.particles)

    def _value(self, weights: Any, seen: TensorDictBase, own: Tensor, peers: Tensor) -> Tensor:
        keys = self.tensor_keys
        entries = {keys.action: own, keys.peers_action: peers}
        value: Tensor = self._called("value_network", weights, seen, entries).get(keys.state_action_value)
        return value.squeeze(-1)

    def _answers(self, weights: Any, seen: TensorDictBase, own: Tensor, noise: Tensor) -> Tensor:
        keys = self.tensor_keys
        entries = {keys.action: own, keys.noise: noise}
        answers: Tensor = self._called("conditional_network", weights, seen, entries).get(keys.peers_action)
        return answers

    def _called(
        self,
        name: str,
        weights: Any,
        seen: TensorDictBase,
        entries: Mapping[NestedKey, Tensor] | None = None,
    ) -> TensorDictBase:
        """What is seen, further entries, and what a network writes for them."""
        network, moment = getattr(self, name), seen.copy()
        for entry, value in (entries or {}).items():
            moment.set(entry, value)
        with weights.to_module(network, preserve_module_state=False):
            written: TensorDictBase = network(moment)
        return written
