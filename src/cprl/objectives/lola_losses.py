"""LOLALoss and LOLADiCELoss: policies that learn, from rollouts, with the others' learning in view."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import ProbabilisticTensorDictSequential
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.objectives import LossModule

from cprl.arguments import number, objects
from cprl.objectives.dice import loaded_dice
from cprl.objectives.lola import (
    Factor,
    Objective,
    checked_factor,
    checked_rate,
    lola_gradients,
    look_ahead_losses,
    looked_ahead,
)

_MOST_WEIGHT: Final = 1e6


class _OfPolicies(LossModule):
    """What both losses have: the policies, and their losses over rollouts as functions of their
    parameters."""

    @dataclass
    class _AcceptedKeys:
        """The names of the entries of rollouts; `set_keys` changes them."""

        observation: NestedKey = "observation"
        action: NestedKey = "action"
        advantage: NestedKey = "advantage"
        done: NestedKey = "done"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    actors: nn.ModuleList
    actors_params: TensorDictParams
    target_actors_params: TensorDictParams
    out_keys = ("loss_objective", "loss_entropy", "entropy")

    def __init__(
        self,
        actors: Sequence[ProbabilisticTensorDictSequential],
        *,
        look_ahead_rate: float,
        gamma: float,
        entropy_coeff: float = 0.0,
    ) -> None:
        super().__init__()
        actors = objects(
            "actors", actors, ProbabilisticTensorDictSequential, "policies, e.g. ProbabilisticActor"
        )
        if len(actors) < 2:
            raise ValueError(f"there are {len(actors)} actors; allowed: two or more, one for each agent")
        self.look_ahead_rate = checked_rate(look_ahead_rate)
        self.gamma = number("gamma", gamma, low=0, high=1, allowed="0..1")
        self.entropy_coeff = number(
            "entropy_coeff", entropy_coeff, low=0, high=_MOST_WEIGHT, allowed=f"0..{_MOST_WEIGHT:g}"
        )
        self.convert_to_functional(nn.ModuleList(actors), "actors")
        self._learned = [
            [key for key, value in self._table(agent).items(True, True) if isinstance(value, nn.Parameter)]
            for agent in range(len(actors))
        ]

    @property
    def in_keys(self) -> list[NestedKey]:
        """The entries that `forward` reads."""
        names = self.tensor_keys
        return [names.observation, names.action, names.advantage, names.done]

    @in_keys.setter
    def in_keys(self, values: object) -> None:
        raise ValueError(f"in_keys is set to {values}; allowed: set_keys(observation=..., action=..., ...)")

    def _forward_value_estimator_keys(self, **kwargs: Any) -> None:
        """There is no value estimator: advantages are in the rollouts."""

    def _table(self, agent: int) -> TensorDictBase:
        table: TensorDictBase = self.actors_params.get(str(agent))
        return table

    def _weights(self) -> list[list[Tensor]]:
        """What each agent learns."""
        return [[self._table(agent).get(key) for key in keys] for agent, keys in enumerate(self._learned)]

    def _policy(self, agent: int, parameters: Sequence[Tensor], rollouts: TensorDictBase) -> Any:
        """The distributions of an agent's actions where the rollouts went."""
        actor: Any = self.actors[agent]
        table = TensorDict(dict(self._table(agent).items(True, True)), [])
        for key, value in zip(self._learned[agent], parameters, strict=True):
            table.set(key, value)
        seen = rollouts.get(self.tensor_keys.observation).select(rollouts.batch_dims, agent)
        with table.to_module(actor):
            return actor.get_dist(TensorDict({"observation": seen}, rollouts.batch_size))

    def _objective(self, rollouts: TensorDictBase) -> Objective:
        """The agents' losses over rollouts [.., B, T], as means over the B rollouts, [.., N]."""
        action = rollouts.get(self.tensor_keys.action)
        advantage = rollouts.get(self.tensor_keys.advantage).squeeze(-1)
        done = rollouts.get(self.tensor_keys.done)

        def losses(parameters: list[list[Tensor]]) -> Tensor:
            taken = [
                self._policy(agent, own, rollouts).log_prob(action.select(rollouts.batch_dims, agent))
                for agent, own in enumerate(parameters)
            ]
            gained = loaded_dice(torch.stack(taken, -1), advantage, gamma=self.gamma, done=done)
            return -gained.mean(-2)

        return losses

    def _losses(self, objective: Tensor, rollouts: TensorDictBase) -> TensorDict:
        """The output of `forward`, whose entropies are those of the present policies."""
        parameters = self._weights()
        each = [self._policy(agent, own, rollouts).entropy() for agent, own in enumerate(parameters)]
        lanes = rollouts.batch_dims - 2
        entropy = torch.stack([own.flatten(lanes).mean(-1) for own in each], -1)
        loss = -self.entropy_coeff * entropy.sum()
        return TensorDict({"loss_objective": objective, "loss_entropy": loss, "entropy": entropy.detach()})


class LOLALoss(_OfPolicies):
    """LOLA by policy gradients: each of N agents expects a naive step of the others, to first order.

    Both factors of the product that LOLA adds are estimated from rollouts, each from a half of them, since
    the product of two estimates from one batch is biased; the halves change places, and the two products are
    averaged. Derivatives of second order come from `loaded_dice`.

    Source: Foerster et al., "Learning with Opponent-Learning Awareness" (2018), section 4.3, for two agents;
    with more, the terms of all others are summed.

    Args:
        actors: the policy of each agent, N of two or more: reads the "observation" of that agent alone,
            [.., *shape], and gives the distribution of its action, e.g. a `ProbabilisticActor`.
        look_ahead_rate: the size of the step, by plain gradient descent, that the others are expected to
            take, 0..1e12; 0 is naive learning.
        gamma: the discount per step, 0..1; the first step of each piece of a rollout counts in full.
        entropy_coeff: the weight of the policies' entropy in the loss, 0..1e6.
        factor: what is differentiated, see `lola_gradients`.

    `forward` reads rollouts [.., B, T], B even: "observation" [.., B, T, N, *shape], "action" [.., B, T, N],
    "advantage" float [.., B, T, N, 1], "done" bool [.., B, T, 1]; `set_keys` renames them. Axes before B hold
    independent groups, such as replicas whose parameters have the same axes in front. Advantages are e.g.
    those of TorchRL's `GAE`; see `loaded_dice` for which are unbiased.

    It returns sums over groups and agents, so that each agent's parameters get the gradient of its own loss:
    "loss_objective", whose value is 0 and whose gradient is LOLA's, under `backward` and `torch.func.grad`,
    of first order only; "loss_entropy"; and "entropy" [.., N], in nats, without a gradient.

    Raises:
        ValueError: if an argument is not allowed, or B is odd; names it and says what is.
    """

    def __init__(
        self,
        actors: Sequence[ProbabilisticTensorDictSequential],
        *,
        look_ahead_rate: float = 1.0,
        gamma: float = 0.99,
        entropy_coeff: float = 0.0,
        factor: Factor = "detached",
    ) -> None:
        super().__init__(actors, look_ahead_rate=look_ahead_rate, gamma=gamma, entropy_coeff=entropy_coeff)
        self.factor = checked_factor(factor)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """See the class."""
        if tensordict.batch_dims < 2 or tensordict.shape[-2] % 2:
            raise ValueError(
                f"the rollouts are {list(tensordict.shape)}; allowed: [.., B, T] with an even B, whose "
                "halves are independent"
            )
        halves = tensordict.chunk(2, tensordict.batch_dims - 2)
        parameters = self._weights()
        gradients, _ = lola_gradients(
            [self._objective(half) for half in halves],
            parameters,
            rate=self.look_ahead_rate,
            factor=self.factor,
        )
        carried = [
            ((value - value.detach()) * slope.detach()).sum()
            for of, slopes in zip(parameters, gradients, strict=True)
            for value, slope in zip(of, slopes, strict=True)
        ]
        return self._losses(torch.stack(carried).sum(), tensordict)


class LOLADiCELoss(_OfPolicies):
    """LOLA by DiCE: each of N agents differentiates through a naive step of the others, and is judged by
    rollouts in which the others had taken it.

    Source: Foerster et al., "DiCE: The Infinitely Differentiable Monte Carlo Estimator" (2018), section 5,
    for two agents and one or more steps; here one step, of all others at once.

    Args:
        actors: see `LOLALoss`, as `look_ahead_rate`, `gamma` and `entropy_coeff`.

    `forward` reads rollouts [.., 1 + N, B, T] with the entries of `LOLALoss`: first B rollouts of the present
    policies; then, for each agent i, B rollouts in which i had its present policy, and the others what
    `look_ahead` makes of the first B rollouts. It returns the entries of `LOLALoss`; what is there the
    gradient of "loss_objective" is here a derivative that can be taken again.

    Raises:
        ValueError: if an argument is not allowed, or there are other rollouts; names it and says what is.
    """

    def __init__(
        self,
        actors: Sequence[ProbabilisticTensorDictSequential],
        *,
        look_ahead_rate: float = 1.0,
        gamma: float = 0.99,
        entropy_coeff: float = 0.0,
    ) -> None:
        super().__init__(actors, look_ahead_rate=look_ahead_rate, gamma=gamma, entropy_coeff=entropy_coeff)

    def look_ahead(self, rollouts: TensorDictBase) -> list[TensorDict]:
        """The parameters of each agent after a naive step, from rollouts [.., B, T] of the present policies;
        new tensors under the names of each actor's own."""
        ahead = looked_ahead(
            self._objective(rollouts),
            [[value.detach() for value in of] for of in self._weights()],
            rate=self.look_ahead_rate,
        )
        return [
            TensorDict({key: value.detach() for key, value in zip(keys, own, strict=True)}, [])
            for keys, own in zip(self._learned, ahead, strict=True)
        ]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """See the class."""
        wanted = 1 + len(self._learned)
        if tensordict.batch_dims < 3 or tensordict.shape[-3] != wanted:
            raise ValueError(f"the rollouts are {list(tensordict.shape)}; allowed: [.., {wanted}, B, T]")
        now, *each = tensordict.unbind(tensordict.batch_dims - 3)
        losses = look_ahead_losses(
            self._objective(now),
            [self._objective(own) for own in each],
            self._weights(),
            rate=self.look_ahead_rate,
        )
        return self._losses(losses.sum(), now)
