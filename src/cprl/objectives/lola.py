"""Learning with opponent-learning awareness (LOLA): gradients that look at how the others are about to learn.

Agent i has the loss L_i(theta_1, .., theta_N). It expects each other agent j to take the step
-rate * dL_j/dtheta_j, which depends on theta_i, and wants a low loss after these steps.

Sources: Foerster, Chen, Al-Shedivat, Whiteson, Abbeel and Mordatch, "Learning with Opponent-Learning
Awareness" (2018), section 4, for `lola_gradients`; Foerster, Farquhar, Al-Shedivat, Rocktäschel, Xing and
Whiteson, "DiCE: The Infinitely Differentiable Monte Carlo Estimator" (2018), section 5, for
`look_ahead_losses`. Both treat two agents; with more, the terms of all others are summed.

DiCE says of rollouts what returns are as numbers whose derivatives of any order are unbiased estimates. With
advantages: Farquhar, Whiteson and Foerster, "Loaded DiCE: Trading off Bias and Variance in Any-Order Score
Function Gradient Estimators for Reinforcement Learning" (2019). A rollout of T steps may hold several
episodes, each a piece of it. Pieces do not influence each other, and the discount of a step counts from the
begin of its piece.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import ProbabilisticTensorDictSequential
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.objectives import LossModule

Parameters: TypeAlias = Sequence[Sequence[Tensor]]
"""For each of N agents the tensors that it learns, of any shapes."""
Objective: TypeAlias = Callable[[list[list[Tensor]]], Tensor]
"""Maps the parameters of N agents to their losses [.., N], by operations that torch differentiates twice."""
_Nested: TypeAlias = list[list[Tensor]]


def lola_gradients(
    objectives: Sequence[Objective], parameters: Parameters, *, rate: float
) -> list[list[Tensor]]:
    """Return the gradient along which each agent descends, of the shapes of `parameters`.

    For agent i it is dL_i/dtheta_i - rate * sum over j of (dL_i/dtheta_j) . (d2L_j/dtheta_j dtheta_i), with
    the first factor of the product as a constant, as in the paper.

    Args:
        objectives: one that is exact; or several independent estimates of it, each from a batch of its own.
            The product of two estimates from one batch is biased, so each estimate of the second derivative
            is multiplied by the mean of the others' first, and all such products are averaged.
        rate: the step size that the others are expected to take, 0..1e12; 0 is naive learning.

    Where losses have axes before the agents', the gradients are those of the sums over them.
    """
    values = [[value.detach() for value in of_agent] for of_agent in parameters]
    estimates: list[Any] = [
        torch.func.vjp(_slopes(objective), values, has_aux=True) for objective in objectives
    ]
    slopes: list[list[_Nested]] = [of_agents for _, _, of_agents in estimates]
    gradients = [_means([each[agent][agent] for each in slopes]) for agent in range(len(values))]
    for number, (_, pull, _) in enumerate(estimates if rate else ()):
        others = slopes[:number] + slopes[number + 1 :] or slopes
        for agent in range(len(values)):
            steps_matter = [
                [torch.zeros_like(value) for value in of_agent]
                if owner == agent
                else [slope.detach() for slope in _means([each[agent][owner] for each in others])]
                for owner, of_agent in enumerate(values)
            ]
            (products,) = pull(steps_matter)
            gradients[agent] = [
                slope - rate / len(estimates) * product
                for slope, product in zip(gradients[agent], products[agent], strict=True)
            ]
    return gradients


def looked_ahead(
    objective: Objective, parameters: Parameters, *, rate: float, still: int | None = None
) -> list[list[Tensor]]:
    """Return the parameters after a naive step of all agents, theta_j - rate * dL_j/dtheta_j; differentiable.

    Args:
        rate: the step size, 0..1e12.
        still: the index of an agent that does not move.
    """
    slopes, _ = _slopes(objective)([list(values) for values in parameters])
    return [
        list(values)
        if agent == still
        else [value - rate * slope for value, slope in zip(values, of_agent, strict=True)]
        for agent, (values, of_agent) in enumerate(zip(parameters, slopes, strict=True))
    ]


def look_ahead_losses(
    inner: Objective, outer: Sequence[Objective], parameters: Parameters, *, rate: float
) -> Tensor:
    """Return the losses of each agent after the others' step, [.., N]; of its gradients, only each agent's
    own exists.

    Nothing is approximated: `backward` of the sum differentiates through the step.

    Args:
        inner: what the others step by.
        outer: what agent i has after their step, for each agent; agent i reads the entry i of its losses.
    """
    losses = []
    for agent, objective in enumerate(outer):
        attached = [
            list(values) if other == agent else [value.detach() for value in values]
            for other, values in enumerate(parameters)
        ]
        losses.append(objective(looked_ahead(inner, attached, rate=rate, still=agent))[..., agent])
    return torch.stack(losses, -1)


def _slopes(objective: Objective) -> Callable[[_Nested], tuple[_Nested, list[_Nested]]]:
    """A function of all parameters: the gradient of each agent's loss by its own; beside them those of each
    agent's loss by the parameters of all."""

    def slopes(parameters: _Nested) -> tuple[_Nested, list[_Nested]]:
        losses: Tensor
        losses, pull = torch.func.vjp(objective, parameters)[:2]
        units = torch.eye(len(parameters), dtype=losses.dtype, device=losses.device)
        of_agents = [pull(unit.expand_as(losses).contiguous())[0] for unit in units]
        return [of_agent[agent] for agent, of_agent in enumerate(of_agents)], of_agents

    return slopes


def _means(tables: Sequence[Sequence[Tensor]]) -> list[Tensor]:
    """The mean of each tensor over several lists of them."""
    if len(tables) == 1:
        return list(tables[0])
    return [torch.stack(values).mean(0) for values in zip(*tables, strict=True)]


def magic_box(log_prob: Tensor) -> Tensor:
    """1, with the derivatives of probabilities relative to what they are: exp(x - stop_gradient(x))."""
    return (log_prob - log_prob.detach()).exp()


def dice_objective(log_prob: Tensor, reward: Tensor, *, gamma: float, done: Tensor | None = None) -> Tensor:
    """Return the mean discounted return of the pieces of each rollout, [.., N], differentiable any number of
    times.

    Args:
        gamma: the discount per step, 0..1.
        done: whether a piece ends with this step, bool [.., T, 1]; by default none does before the last.
    """
    steps = _steps(log_prob, gamma, done)
    return (steps.discount * steps.so_far * reward).sum(-2) / steps.pieces


def loaded_dice(log_prob: Tensor, advantage: Tensor, *, gamma: float, done: Tensor | None = None) -> Tensor:
    """Return zeros [.., N] with the derivatives, of any order, of the mean discounted return of pieces.

    Args:
        advantage: an estimate of each action's advantage, float [.., T, N], without a gradient. Returns to
            the end of the piece less a baseline are unbiased, and then this is `dice_objective`, less its
            value; what bootstraps, as generalised advantage estimates do, has less variance and a bias.
    """
    steps = _steps(log_prob, gamma, done)
    gained = steps.discount * (steps.so_far - steps.before) * advantage.detach()
    return gained.sum(-2) / steps.pieces


class _Steps(NamedTuple):
    """Of each step of rollouts [.., T, 1]."""

    so_far: Tensor
    """The magic box of all actions from the begin of the piece up to the step, all agents'."""
    before: Tensor
    """The same up to the step before."""
    discount: Tensor
    """gamma to the number of steps since the begin of the piece."""
    pieces: Tensor
    """How many pieces the rollout has, [.., 1]."""


def _steps(log_prob: Tensor, gamma: float, done: Tensor | None) -> _Steps:
    joint = log_prob.sum(-1, keepdim=True)
    if done is None:
        done = torch.zeros_like(joint, dtype=torch.bool)
    begins = torch.cat([torch.ones_like(done[..., :1, :]), done[..., :-1, :]], -2)
    index = torch.arange(joint.shape[-2], device=joint.device).unsqueeze(-1).expand_as(begins)
    first = torch.where(begins, index, 0).cummax(-2).values
    total = joint.cumsum(-2)
    earlier = (total - joint).gather(-2, first)
    discount = torch.as_tensor(gamma, dtype=joint.dtype, device=joint.device) ** (index - first)
    pieces = begins.sum(-2).to(joint.dtype)
    return _Steps(magic_box(total - earlier), magic_box(total - joint - earlier), discount, pieces)


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
        look_ahead_rate: float = 1.0,
        gamma: float = 0.99,
        entropy_coeff: float = 0.0,
    ) -> None:
        super().__init__()
        self.look_ahead_rate, self.gamma, self.entropy_coeff = look_ahead_rate, gamma, entropy_coeff
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
        action, advantage, done = (rollouts.get(name) for name in self.in_keys[1:])

        def losses(parameters: list[list[Tensor]]) -> Tensor:
            taken = [
                self._policy(agent, weights, rollouts).log_prob(action.select(rollouts.batch_dims, agent))
                for agent, weights in enumerate(parameters)
            ]
            gained = loaded_dice(torch.stack(taken, -1), advantage.squeeze(-1), gamma=self.gamma, done=done)
            return -gained.mean(-2)

        return losses

    def _losses(self, objective: Tensor, rollouts: TensorDictBase) -> TensorDict:
        """The output of `forward`, whose entropies are those of the present policies."""
        each = [
            self._policy(agent, weights, rollouts).entropy() for agent, weights in enumerate(self._weights())
        ]
        lanes = rollouts.batch_dims - 2
        entropy = torch.stack([entropy.flatten(lanes).mean(-1) for entropy in each], -1)
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

    `forward` reads rollouts [.., B, T], B even: "observation" [.., B, T, N, *shape], "action" [.., B, T, N],
    "advantage" float [.., B, T, N, 1], "done" bool [.., B, T, 1]; `set_keys` renames them. Axes before B hold
    independent groups, such as replicas whose parameters have the same axes in front. Advantages are e.g.
    those of TorchRL's `GAE`; see `loaded_dice` for which are unbiased.

    It returns sums over groups and agents, so that each agent's parameters get the gradient of its own loss:
    "loss_objective", whose value is 0 and whose gradient is LOLA's, under `backward` and `torch.func.grad`,
    of first order only; "loss_entropy"; and "entropy" [.., N], in nats, without a gradient.
    """

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        if tensordict.batch_dims < 2 or tensordict.shape[-2] % 2:
            raise ValueError(
                f"the rollouts are {list(tensordict.shape)}; allowed: [.., B, T] with an even B, whose "
                "halves are independent"
            )
        objectives = [self._objective(half) for half in tensordict.chunk(2, tensordict.batch_dims - 2)]
        parameters = self._weights()
        gradients = lola_gradients(objectives, parameters, rate=self.look_ahead_rate)
        carried = [
            ((value - value.detach()) * slope.detach()).sum()
            for values, slopes in zip(parameters, gradients, strict=True)
            for value, slope in zip(values, slopes, strict=True)
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
    """

    def look_ahead(self, rollouts: TensorDictBase) -> list[TensorDict]:
        """The parameters of each agent after a naive step, from rollouts [.., B, T] of the present policies;
        new tensors under the names of each actor's own."""
        ahead = looked_ahead(
            self._objective(rollouts),
            [[value.detach() for value in values] for values in self._weights()],
            rate=self.look_ahead_rate,
        )
        return [
            TensorDict({key: value.detach() for key, value in zip(keys, values, strict=True)}, [])
            for keys, values in zip(self._learned, ahead, strict=True)
        ]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        wanted = 1 + len(self._learned)
        if tensordict.batch_dims < 3 or tensordict.shape[-3] != wanted:
            raise ValueError(f"the rollouts are {list(tensordict.shape)}; allowed: [.., {wanted}, B, T]")
        now, *each = tensordict.unbind(tensordict.batch_dims - 3)
        losses = look_ahead_losses(
            self._objective(now),
            [self._objective(rollouts) for rollouts in each],
            self._weights(),
            rate=self.look_ahead_rate,
        )
        return self._losses(losses.sum(), now)
