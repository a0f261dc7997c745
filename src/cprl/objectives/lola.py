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
from typing import Any, Literal, NamedTuple, TypeAlias

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
Factor: TypeAlias = Literal["detached", "both"]
"""What is differentiated of the product of two gradients that LOLA adds to a loss: "detached", the step of
the others alone, as in the paper; "both", also the factor by which their step matters."""

_Flat: TypeAlias = tuple[Tensor, ...]
_Slopes: TypeAlias = dict[tuple[int, int], Tensor]
"""The gradient of the loss of an agent by a tensor, by the place of each."""


def lola_gradients(
    objectives: Sequence[Objective], parameters: Parameters, *, rate: float, factor: Factor = "detached"
) -> tuple[list[list[Tensor]], Tensor]:
    """The gradient along which each agent descends, and the losses.

    For agent i it is dL_i/dtheta_i - rate * sum over j of (dL_i/dtheta_j) . (d2L_j/dtheta_j dtheta_i), with
    the first factor of the product as a constant, or differentiated too, see `Factor`.

    Args:
        objectives: one that is exact; or several independent estimates of it, each from a batch of its own.
            The product of two estimates from one batch is biased, so each estimate of the second derivative
            is multiplied by the mean of the others' first, and all such products are averaged.
        rate: the step size that the others are expected to take, 0..1e12; 0 is naive learning.

    Returns:
        Gradients of the shapes of `parameters`, and the mean of the losses of the objectives, [.., N],
        without a gradient. Where losses have axes before the agents', the gradients are those of the sums
        over them.
    """
    flat, owners = _flat(parameters)
    flat = tuple(value.detach() for value in flat)
    agents = range(len(parameters))
    followed = [(i, p) for i in agents for p, owner in enumerate(owners) if factor == "both" or owner == i]
    estimates: list[Any] = [
        torch.func.vjp(_slopes(objective, owners, followed), *flat, has_aux=True) for objective in objectives
    ]
    slopes: list[_Slopes] = [aux[0] for _, _, aux in estimates]
    gradients = [_mean([slope[i, p] for slope in slopes]) for p, i in enumerate(owners)]
    for one, (_, pull, _) in enumerate(estimates if rate else ()):
        others = slopes[:one] + slopes[one + 1 :] or slopes
        for i in agents:
            for p, product in enumerate(pull(_weights(i, followed, owners, others))):
                if owners[p] == i:
                    gradients[p] = gradients[p] - rate / len(estimates) * product
    losses = _mean([aux[1].detach() for _, _, aux in estimates])
    return _by_agent(gradients, owners), losses


def looked_ahead(
    objective: Objective, parameters: Parameters, *, rate: float, steps: int = 1, still: int | None = None
) -> list[list[Tensor]]:
    """The parameters after naive steps of all agents: theta_j - rate * dL_j/dtheta_j, so often.

    They are differentiable by `parameters`.

    Args:
        rate: the step size, 0..1e12.
        steps: how many steps, 1..1000.
        still: the index of an agent that does not move.
    """
    flat, owners = _flat(parameters)
    followed = [(i, p) for p, i in enumerate(owners) if i != still]
    for _ in range(steps):
        slopes = dict(zip(followed, _slopes(objective, owners, followed)(*flat)[0], strict=True))
        flat = tuple(
            value - rate * slopes[i, p] if (i, p) in slopes else value
            for p, (i, value) in enumerate(zip(owners, flat, strict=True))
        )
    return _by_agent(flat, owners)


def look_ahead_losses(
    inner: Objective,
    outer: Sequence[Objective],
    parameters: Parameters,
    *,
    rate: float,
    steps: int = 1,
) -> Tensor:
    """The losses of each agent after the others' steps, [.., N]; of its gradients, only each agent's own
    exists.

    Nothing is approximated: `backward` of the sum differentiates through the steps.

    Args:
        inner: what the others step by.
        outer: what agent i has after their steps, for each agent; agent i reads the entry i of its losses.
        steps: how many steps they take, 1..1000.
    """
    losses = []
    for i, objective in enumerate(outer):
        attached = [
            list(of) if j == i else [value.detach() for value in of] for j, of in enumerate(parameters)
        ]
        ahead = looked_ahead(inner, attached, rate=rate, steps=steps, still=i)
        losses.append(objective(ahead)[..., i])
    return torch.stack(losses, -1)


def _slopes(
    objective: Objective, owners: list[int], followed: list[tuple[int, int]]
) -> Callable[..., tuple[_Flat, tuple[_Slopes, Tensor]]]:
    """A function of all tensors: the gradients that are followed, and beside them all gradients and
    losses."""

    def slopes(*flat: Tensor) -> tuple[_Flat, tuple[_Slopes, Tensor]]:
        agents = owners[-1] + 1

        def losses_of(*values: Tensor) -> Tensor:
            return objective(_by_agent(values, owners))

        losses: Tensor
        losses, pull = torch.func.vjp(losses_of, *flat)[:2]
        units = torch.eye(agents, dtype=losses.dtype, device=losses.device)
        every = {
            (i, p): slope
            for i in range(agents)
            for p, slope in enumerate(pull(units[i].expand_as(losses).contiguous()))
        }
        return tuple(every[at] for at in followed), (every, losses)

    return slopes


def _weights(
    i: int, followed: list[tuple[int, int]], owners: list[int], estimates: Sequence[_Slopes]
) -> _Flat:
    """What the gradients that are followed are multiplied by for agent i: where they are another agent's
    step, by how much it matters to i; where they are how much that matters, by the step."""

    def weight(j: int, p: int) -> Tensor:
        first = estimates[0][j, p]
        if i == owners[p] or i != j != owners[p]:
            return torch.zeros_like(first)
        return _mean([slopes[i if j == owners[p] else owners[p], p] for slopes in estimates]).detach()

    return tuple(weight(j, p) for j, p in followed)


def _mean(values: Sequence[Tensor]) -> Tensor:
    return values[0] if len(values) == 1 else torch.stack(list(values)).mean(0)


def _flat(parameters: Parameters) -> tuple[_Flat, list[int]]:
    """All tensors, and the agent of each."""
    pairs = [(value, agent) for agent, of in enumerate(parameters) for value in of]
    return tuple(value for value, _ in pairs), [agent for _, agent in pairs]


def _by_agent(values: Sequence[Tensor], owners: list[int]) -> list[list[Tensor]]:
    return [
        [value for value, owner in zip(values, owners, strict=True) if owner == agent]
        for agent in range(owners[-1] + 1)
    ]


def magic_box(log_prob: Tensor) -> Tensor:
    """1, with the derivatives of probabilities relative to what they are: exp(x - stop_gradient(x))."""
    return (log_prob - log_prob.detach()).exp()


def dice_objective(
    log_prob: Tensor,
    reward: Tensor,
    *,
    gamma: float,
    done: Tensor | None = None,
    baseline: Tensor | None = None,
) -> Tensor:
    """The mean discounted return of the pieces of each rollout, [.., N], differentiable any number of times.

    Args:
        gamma: the discount per step, 0..1.
        done: whether a piece ends with this step, bool [.., T, 1]; by default none does before the last.
        baseline: what the returns from a step on are compared with, float [.., T, N], without a gradient. It
            may depend on all that was there before the step's actions. It changes no expected derivative of
            any order, and the variance of all: DiCE's own, which serves the first order, has the term
            (1 - box of the step) here, which is (boxes up to the step before - boxes up to the step).
    """
    steps = _steps(log_prob, gamma, done)
    paid = steps.so_far * reward
    if baseline is not None:
        paid = paid + (steps.before - steps.so_far) * baseline.detach()
    return (steps.discount * paid).sum(-2) / steps.pieces


def loaded_dice(log_prob: Tensor, advantage: Tensor, *, gamma: float, done: Tensor | None = None) -> Tensor:
    """Zeros [.., N] with the derivatives, of any order, of the mean discounted return of pieces.

    Args:
        advantage: an estimate of each action's advantage, float [.., T, N], without a gradient. Returns to
            the end of the piece less a baseline are unbiased, and then this is `dice_objective`, less its
            value; what bootstraps, as generalised advantage estimates do, has less variance and a bias.
        gamma: the discount per step, 0..1.
        done: whether a piece ends with this step, bool [.., T, 1]; by default none does before the last.
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
        action = rollouts.get(self.tensor_keys.action)
        advantage = rollouts.get(self.tensor_keys.advantage).squeeze(-1)
        done = rollouts.get(self.tensor_keys.done)

        def losses(parameters: list[list[Tensor]]) -> Tensor:
            taken = [
                self._policy(agent, weights, rollouts).log_prob(action.select(rollouts.batch_dims, agent))
                for agent, weights in enumerate(parameters)
            ]
            gained = loaded_dice(torch.stack(taken, -1), advantage, gamma=self.gamma, done=done)
            return -gained.mean(-2)

        return losses

    def _losses(self, objective: Tensor, rollouts: TensorDictBase) -> TensorDict:
        """The output of `forward`, whose entropies are those of the present policies."""
        parameters = self._weights()
        each = [self._policy(agent, weights, rollouts).entropy() for agent, weights in enumerate(parameters)]
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
        factor: what is differentiated, see `lola_gradients`.

    `forward` reads rollouts [.., B, T], B even: "observation" [.., B, T, N, *shape], "action" [.., B, T, N],
    "advantage" float [.., B, T, N, 1], "done" bool [.., B, T, 1]; `set_keys` renames them. Axes before B hold
    independent groups, such as replicas whose parameters have the same axes in front. Advantages are e.g.
    those of TorchRL's `GAE`; see `loaded_dice` for which are unbiased.

    It returns sums over groups and agents, so that each agent's parameters get the gradient of its own loss:
    "loss_objective", whose value is 0 and whose gradient is LOLA's, under `backward` and `torch.func.grad`,
    of first order only; "loss_entropy"; and "entropy" [.., N], in nats, without a gradient.
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
        self.factor = factor

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
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
    """

    def look_ahead(self, rollouts: TensorDictBase) -> list[TensorDict]:
        """The parameters of each agent after a naive step, from rollouts [.., B, T] of the present policies;
        new tensors under the names of each actor's own."""
        ahead = looked_ahead(
            self._objective(rollouts),
            [[value.detach() for value in of] for of in self._weights()],
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


def iterated_value(probabilities: Tensor, payoffs: Tensor | Sequence[Any], *, gamma: float) -> Tensor:
    """The discounted return of each of N agents who repeat a matrix game for ever, [.., N].

    It is p_0 (I - gamma P)^-1 r, where p_0 has the chances of the joint actions of the first turn, row a of P
    those of the turn after the joint action a, and r the payoffs. Times (1 - gamma) it is a mean per turn.

    Args:
        probabilities: of the actions of each agent, float [.., N, A**N + 1, A], after each joint action of
            the last turn, whose number is a_1 * A**(N-1) + .. + a_N; in the last row, at the first turn.
            Every agent sees the joint action in the same order.
        payoffs: of the joint actions, [A, .., A, N]; nested tuples or a tensor.
        gamma: the discount per turn, 0 or more and below 1.

    Source: Foerster et al., "Learning with Opponent-Learning Awareness" (2018), whose exact learners use it.
    """
    paid = torch.as_tensor(payoffs, dtype=probabilities.dtype, device=probabilities.device)
    agents, joint = paid.ndim - 1, paid.shape[0] ** (paid.ndim - 1)
    chances = probabilities[..., 0, :, :]
    for agent in range(1, agents):
        chances = (chances.unsqueeze(-1) * probabilities[..., agent, :, None, :]).flatten(-2)
    after, first = chances[..., :joint, :], chances[..., joint, :]
    visits: Tensor = torch.linalg.solve(torch.eye(joint).to(after) - gamma * after.mT, first)
    return visits @ paid.reshape(joint, agents)
