"""Learning with opponent-learning awareness (LOLA): gradients that anticipate the others' learning step.

Agent i has the loss L_i(theta_1, .., theta_N). It expects each other agent j to take the step
-rate * dL_j/dtheta_j, which depends on theta_i, and wants a low loss after these steps.

Sources: Foerster, Chen, Al-Shedivat, Whiteson, Abbeel and Mordatch, "Learning with Opponent-Learning
Awareness" (2018), section 4, for `lola_gradients`; Foerster, Farquhar, Al-Shedivat, Rocktäschel, Xing and
Whiteson, "DiCE: The Infinitely Differentiable Monte Carlo Estimator" (2018), section 5, for
`look_ahead_losses`. Both treat two agents; with more, the terms of all others are summed.

DiCE estimates returns from rollouts by numbers whose derivatives of any order are unbiased estimates, too.
Loaded DiCE does so with advantages: Farquhar, Whiteson and Foerster, "Loaded DiCE: Trading off Bias and
Variance in Any-Order Score Function Gradient Estimators for Reinforcement Learning" (2019). A rollout of T
steps may hold several episodes, each a segment of it. Segments do not influence each other, and the discount
of a step counts from the beginning of its segment.
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
"""The tensors that each of N agents learns, of any shapes."""
Objective: TypeAlias = Callable[[list[list[Tensor]]], Tensor]
"""A function from the parameters of N agents to their losses, [.., N], that torch can differentiate twice."""
_Nested: TypeAlias = list[list[Tensor]]
"""Tensors in the form of `Parameters`, e.g. gradients."""


def lola_gradients(
    objectives: Sequence[Objective], parameters: Parameters, *, rate: float
) -> list[list[Tensor]]:
    """Return the gradient along which each agent descends, in the shapes of `parameters`.

    For agent i it is dL_i/dtheta_i - rate * sum over j of (dL_i/dtheta_j) . (d2L_j/dtheta_j dtheta_i), with
    the first factor of the product as a constant, as in the paper.

    Args:
        objectives: one exact objective; or several independent estimates of it, each from a batch of its own.
            The product of two estimates from one batch is biased. So the second derivative of each estimate
            is multiplied by the mean first derivative of the other estimates, and these products are
            averaged.
        rate: the step size that the others are expected to take, 0..1e12; 0 is naive learning.

    Where losses have axes before the agents', the gradients are those of the sums over them.
    """
    values = [_detach(agent_parameters) for agent_parameters in parameters]
    estimates: list[Any] = [
        torch.func.vjp(_gradient_function(objective), values, has_aux=True) for objective in objectives
    ]
    tables: list[list[_Nested]] = [table for _, _, table in estimates]
    gradients = [_mean_gradient(tables, agent, agent) for agent in range(len(values))]
    if not rate:
        return gradients
    for number, (_, second_derivatives, _) in enumerate(estimates):
        other_tables = tables[:number] + tables[number + 1 :] or tables  # an exact objective is its own other
        for agent in range(len(values)):
            factors = [_detach(_mean_gradient(other_tables, agent, peer)) for peer in range(len(values))]
            factors[agent] = [torch.zeros_like(value) for value in values[agent]]
            (products,) = second_derivatives(factors)
            gradients[agent] = _descend(gradients[agent], products[agent], rate / len(estimates))
    return gradients


def looked_ahead(
    objective: Objective, parameters: Parameters, *, rate: float, fixed_agent: int | None = None
) -> list[list[Tensor]]:
    """Return the parameters of all agents after a naive step of each, theta_j - rate * dL_j/dtheta_j.

    The step can be differentiated.

    Args:
        rate: the step size, 0..1e12.
        fixed_agent: the index of an agent that does not move.
    """
    gradients, _ = _gradient_function(objective)([list(values) for values in parameters])
    ahead = []
    for values, agent_gradients in zip(parameters, gradients, strict=True):
        ahead.append(_descend(values, agent_gradients, rate))
    if fixed_agent is not None:
        ahead[fixed_agent] = list(parameters[fixed_agent])
    return ahead


def look_ahead_losses(
    inner: Objective, outer: Sequence[Objective], parameters: Parameters, *, rate: float
) -> Tensor:
    """Return the loss of each agent after the others' step, [.., N].

    Each loss has a gradient by its own agent's parameters alone. `backward` of the sum differentiates
    through the step, without an approximation.

    Args:
        inner: the losses by which the others step.
        outer: for each agent i, the losses after the others' step, of which only entry i is used.
    """
    losses = []
    for agent, objective in enumerate(outer):
        agent_parameters = [_detach(values) for values in parameters]
        agent_parameters[agent] = list(parameters[agent])
        ahead = looked_ahead(inner, agent_parameters, rate=rate, fixed_agent=agent)
        losses.append(objective(ahead)[..., agent])
    return torch.stack(losses, -1)


def _gradient_function(objective: Objective) -> Callable[[_Nested], tuple[_Nested, list[_Nested]]]:
    """Return a function from all parameters to gradients of the agents' losses.

    It returns the gradient of each agent's loss by the agent's own parameters; and a table, whose entry
    [i][j] is the gradient of agent i's loss by the parameters of agent j.
    """

    def gradients(parameters: _Nested) -> tuple[_Nested, list[_Nested]]:
        losses: Tensor
        losses, gradient_of_sum = torch.func.vjp(objective, parameters)[:2]
        units = torch.eye(len(parameters), dtype=losses.dtype, device=losses.device)
        table = [gradient_of_sum(unit.expand_as(losses).contiguous())[0] for unit in units]
        return [row[agent] for agent, row in enumerate(table)], table

    return gradients


def _mean_gradient(tables: Sequence[list[_Nested]], agent: int, peer: int) -> list[Tensor]:
    """Return the gradient of an agent's loss by the parameters of an agent, the mean over several tables of
    `_gradient_function`."""
    by_parameter = zip(*(table[agent][peer] for table in tables), strict=True)
    return [torch.stack(estimates).mean(0) for estimates in by_parameter]


def _detach(values: Sequence[Tensor]) -> list[Tensor]:
    """Return tensors without their history of gradients."""
    return [value.detach() for value in values]


def _descend(values: Sequence[Tensor], gradients: Sequence[Tensor], rate: float) -> list[Tensor]:
    """Return values after one step of gradient descent."""
    return [value - rate * gradient for value, gradient in zip(values, gradients, strict=True)]


def magic_box(log_prob: Tensor) -> Tensor:
    """Return DiCE's magic box, exp(x - stop_gradient(x)): its value is 1, and its derivatives are those of a
    probability relative to its value."""
    return (log_prob - log_prob.detach()).exp()


def dice_objective(log_prob: Tensor, reward: Tensor, *, gamma: float, done: Tensor | None = None) -> Tensor:
    """Return the mean discounted return of the segments of each rollout, [.., N], differentiable any number
    of times.

    Args:
        log_prob: the log-probability of each action, float [.., T, N], with a gradient.
        reward: the reward of each step, float [.., T, N].
        gamma: the discount per step, 0..1.
        done: marks the steps with which a segment ends, bool [.., T, 1]; by default only the last step.
    """
    steps = _steps(log_prob, gamma, done)
    return (steps.discount * steps.so_far * reward).sum(-2) / steps.segments


def loaded_dice(log_prob: Tensor, advantage: Tensor, *, gamma: float, done: Tensor | None = None) -> Tensor:
    """Return zeros, [.., N], with the derivatives of any order of the mean discounted return of segments.

    Args:
        log_prob: see `dice_objective`, also for `gamma` and `done`.
        advantage: an estimate of the advantage of each action, float [.., T, N], without a gradient. If it is
            the return to the end of the segment less a baseline, it is unbiased, and the result is that of
            `dice_objective` less its value. An estimate that bootstraps, such as GAE, has a bias and less
            variance.
    """
    steps = _steps(log_prob, gamma, done)
    terms = steps.discount * (steps.so_far - steps.before) * advantage.detach()
    return terms.sum(-2) / steps.segments


class _Steps(NamedTuple):
    """Numbers of each step of rollouts [.., T, 1]."""

    so_far: Tensor
    """The magic box of the actions of all agents, from the beginning of the segment up to this step."""
    before: Tensor
    """The same up to the step before."""
    discount: Tensor
    """gamma to the power of the number of steps since the beginning of the segment."""
    segments: Tensor
    """The number of segments of the rollout, [.., 1]."""


def _steps(log_prob: Tensor, gamma: float, done: Tensor | None) -> _Steps:
    """Return the numbers of each step; `dice_objective` says the arguments."""
    joint = log_prob.sum(-1, keepdim=True)
    if done is None:
        done = torch.zeros_like(joint, dtype=torch.bool)
    begins = torch.cat([torch.ones_like(done[..., :1, :]), done[..., :-1, :]], -2)
    index = torch.arange(joint.shape[-2], device=joint.device).unsqueeze(-1).expand_as(begins)
    first = torch.where(begins, index, 0).cummax(-2).values
    total = joint.cumsum(-2)
    earlier = (total - joint).gather(-2, first)
    discount = torch.as_tensor(gamma, dtype=joint.dtype, device=joint.device) ** (index - first)
    segments = begins.sum(-2).to(joint.dtype)
    return _Steps(magic_box(total - earlier), magic_box(total - joint - earlier), discount, segments)


class _PolicyLoss(LossModule):
    """The base of both losses: it computes agents' losses in rollouts as functions of their parameters."""

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
        self.look_ahead_rate = look_ahead_rate
        self.gamma = gamma
        self.entropy_coeff = entropy_coeff
        self.convert_to_functional(nn.ModuleList(actors), "actors")
        self._learned = [self._learned_keys(agent) for agent in range(len(actors))]

    @property
    def in_keys(self) -> list[NestedKey]:
        """Return the entries that `forward` reads."""
        names = self.tensor_keys
        return [names.observation, names.action, names.advantage, names.done]

    def _forward_value_estimator_keys(self, **kwargs: Any) -> None:
        """Do nothing: there is no value estimator, advantages are in the rollouts."""

    def _actor_weights(self, agent: int) -> TensorDictBase:
        """Return all weights of an agent's actor."""
        return self.actors_params.get(str(agent))

    def _learned_keys(self, agent: int) -> list[NestedKey]:
        """Return the names of the weights of an actor that the agent learns."""
        entries = self._actor_weights(agent).items(True, True)
        return [key for key, value in entries if isinstance(value, nn.Parameter)]

    def _learned_values(self) -> list[list[Tensor]]:
        """Return the tensors that each agent learns."""
        return [list(map(self._actor_weights(agent).get, keys)) for agent, keys in enumerate(self._learned)]

    def _policy(self, agent: int, parameters: Sequence[Tensor], rollouts: TensorDictBase) -> Any:
        """Return the distributions of an agent's actions in the states of rollouts, by given parameters."""
        actor: Any = self.actors[agent]
        weights = TensorDict(dict(self._actor_weights(agent).items(True, True)), [])
        for key, value in zip(self._learned[agent], parameters, strict=True):
            weights.set(key, value)
        observation = rollouts.get(self.tensor_keys.observation).select(rollouts.batch_dims, agent)
        with weights.to_module(actor):
            return actor.get_dist(TensorDict({"observation": observation}, rollouts.batch_size))

    def _objective(self, rollouts: TensorDictBase) -> Objective:
        """Return a function from all parameters to the agents' losses in rollouts [.., B, T]: the means over
        the B rollouts, [.., N]."""
        action, advantage, done = (rollouts.get(name) for name in self.in_keys[1:])

        def losses(parameters: list[list[Tensor]]) -> Tensor:
            log_probs = [
                self._policy(agent, weights, rollouts).log_prob(action.select(rollouts.batch_dims, agent))
                for agent, weights in enumerate(parameters)
            ]
            joint = torch.stack(log_probs, -1)
            return -loaded_dice(joint, advantage.squeeze(-1), gamma=self.gamma, done=done).mean(-2)

        return losses

    def _losses(self, objective: Tensor, rollouts: TensorDictBase) -> TensorDict:
        """Return the output of `forward`: the objective, and the entropies of the current policies."""
        policies = enumerate(self._learned_values())
        entropies = [self._policy(agent, weights, rollouts).entropy() for agent, weights in policies]
        rollout_axis = rollouts.batch_dims - 2
        entropy = torch.stack([by_step.flatten(rollout_axis).mean(-1) for by_step in entropies], -1)
        loss = -self.entropy_coeff * entropy.sum()
        return TensorDict({"loss_objective": objective, "loss_entropy": loss, "entropy": entropy.detach()})


class LOLALoss(_PolicyLoss):
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
        gamma: the discount per step, 0..1; the first step of each segment of a rollout counts in full.
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
        parameters = self._learned_values()
        gradients = lola_gradients(objectives, parameters, rate=self.look_ahead_rate)
        # Terms of value 0 whose gradients by the parameters are LOLA's.
        terms = [
            ((value - value.detach()) * gradient.detach()).sum()
            for values, agent_gradients in zip(parameters, gradients, strict=True)
            for value, gradient in zip(values, agent_gradients, strict=True)
        ]
        return self._losses(torch.stack(terms).sum(), tensordict)


class LOLADiCELoss(_PolicyLoss):
    """LOLA by DiCE: each of N agents differentiates through a naive step of the others; its loss is that in
    rollouts in which the others have taken this step.

    Source: Foerster et al., "DiCE: The Infinitely Differentiable Monte Carlo Estimator" (2018), section 5,
    for two agents and one or more steps; here one step, of all others at once.

    Args:
        actors: see `LOLALoss`, also for `look_ahead_rate`, `gamma` and `entropy_coeff`.

    `forward` reads rollouts [.., 1 + N, B, T] with the entries of `LOLALoss`: first B rollouts of the current
    policies; then, for each agent i, B rollouts in which i had its current policy, and the others had the
    parameters that `look_ahead` returns for the first B rollouts. It returns the entries of `LOLALoss`; here
    "loss_objective" can be differentiated more than once.
    """

    def look_ahead(self, rollouts: TensorDictBase) -> list[TensorDict]:
        """Return the parameters of each agent after a naive step, as new tensors under the names of the
        actor's parameters.

        Args:
            rollouts: [.., B, T], played by the current policies.
        """
        parameters = [_detach(values) for values in self._learned_values()]
        ahead = looked_ahead(self._objective(rollouts), parameters, rate=self.look_ahead_rate)
        actors = []
        for keys, values in zip(self._learned, ahead, strict=True):
            actors.append(TensorDict(dict(zip(keys, _detach(values), strict=True)), []))
        return actors

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        rollouts = 1 + len(self._learned)
        if tensordict.batch_dims < 3 or tensordict.shape[-3] != rollouts:
            raise ValueError(f"the rollouts are {list(tensordict.shape)}; allowed: [.., {rollouts}, B, T]")
        current, *after = tensordict.unbind(tensordict.batch_dims - 3)
        losses = look_ahead_losses(
            self._objective(current),
            [self._objective(rollout) for rollout in after],
            self._learned_values(),
            rate=self.look_ahead_rate,
        )
        return self._losses(losses.sum(), current)
