"""Learning with opponent-learning awareness (LOLA): gradients that look at how the others are about to learn.

Agent i has the loss L_i(theta_1, .., theta_N). It expects each other agent j to take the step
-rate * dL_j/dtheta_j, which depends on theta_i, and wants a low loss after these steps.

Sources: Foerster, Chen, Al-Shedivat, Whiteson, Abbeel and Mordatch, "Learning with Opponent-Learning
Awareness" (2018), section 4, for `lola_gradients`; Foerster, Farquhar, Al-Shedivat, Rocktäschel, Xing and
Whiteson, "DiCE: The Infinitely Differentiable Monte Carlo Estimator" (2018), section 5, for
`look_ahead_losses`. Both treat two agents; with more, the terms of all others are summed.
"""

from collections.abc import Callable, Sequence
from typing import Any, Final, Literal, TypeAlias, get_args

import torch
from torch import Tensor

from cprl.arguments import callable_of, integer, listed, number, object_of, objects
from cprl.checks import checked, one_of

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

_OBJECTIVE: Final = "a function of the parameters of N agents to their losses"
_HIGHEST: Final = 1e12
_MOST_STEPS: Final = 1000


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
        parameters: of N agents.
        rate: the step size that the others are expected to take, 0..1e12; 0 is naive learning.
        factor: what is differentiated.

    Returns:
        Gradients of the shapes of `parameters`, and the mean of the losses of the objectives, [.., N],
        without a gradient. Where losses have axes before the agents', the gradients are those of the sums
        over them.

    Raises:
        ValueError: for a rate that is not allowed, another factor, no objective, and losses of another number
            of agents.
    """
    checked_rate(rate)
    checked_factor(factor)
    objectives = _functions("objectives", objectives)
    flat, owners = _flat(parameters)
    flat = tuple(value.detach() for value in flat)
    agents = range(len(parameters))
    followed = [(i, p) for i in agents for p, own in enumerate(owners) if factor == "both" or own == i]
    estimates: list[Any] = [
        torch.func.vjp(_slopes(own, owners, followed), *flat, has_aux=True) for own in objectives
    ]
    slopes: list[_Slopes] = [aux[0] for _, _, aux in estimates]
    gradients = [_mean([own[i, p] for own in slopes]) for p, i in enumerate(owners)]
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
        objective: gives the losses.
        parameters: of N agents.
        rate: the step size, 0..1e12.
        steps: how many steps, 1..1000.
        still: the index of an agent that does not move.

    Raises:
        ValueError: for what is not allowed, and losses of another number of agents.
    """
    checked_rate(rate)
    integer("steps", steps, 1, _MOST_STEPS)
    callable_of("objective", objective, _OBJECTIVE)
    flat, owners = _flat(parameters)
    if still is not None:
        integer("still", still, 0, owners[-1])
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
        parameters: of N agents.
        rate: the step size of the others, 0..1e12.
        steps: how many steps they take, 1..1000.

    Raises:
        ValueError: for what is not allowed, and losses of another number of agents.
    """
    callable_of("inner", inner, _OBJECTIVE)
    outer = _functions("outer", outer)
    _flat(parameters)
    if len(outer) != len(parameters):
        raise ValueError(
            f"outer has {len(outer)} objectives; allowed: one for each of {len(parameters)} agents"
        )
    losses = []
    for i, own in enumerate(outer):
        mine = [list(of) if j == i else [value.detach() for value in of] for j, of in enumerate(parameters)]
        ahead = looked_ahead(inner, mine, rate=rate, steps=steps, still=i)
        losses.append(_of_agents(own(ahead), len(parameters))[..., i])
    return torch.stack(losses, -1)


def checked_rate(rate: Any) -> float:
    """The rate; raises a ValueError for anything but a number in 0..1e12."""
    return number("rate", rate, low=0, high=_HIGHEST, allowed=f"0..{_HIGHEST:g}")


def checked_factor(factor: Any) -> Factor:
    """The factor; raises a ValueError for anything else."""
    known: Factor = checked("factor", factor, one_of(*get_args(Factor)))
    return known


def _slopes(
    objective: Objective, owners: list[int], followed: list[tuple[int, int]]
) -> Callable[..., tuple[_Flat, tuple[_Slopes, Tensor]]]:
    """A function of all tensors: the gradients that are followed, and beside them all gradients and
    losses."""

    def slopes(*flat: Tensor) -> tuple[_Flat, tuple[_Slopes, Tensor]]:
        agents = owners[-1] + 1

        def losses_of(*values: Tensor) -> Tensor:
            return _of_agents(objective(_by_agent(values, owners)), agents)

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
        return _mean([own[i if j == owners[p] else owners[p], p] for own in estimates]).detach()

    return tuple(weight(j, p) for j, p in followed)


def _functions(name: str, given: Any) -> tuple[Objective, ...]:
    """One or more objectives; raises a ValueError for anything else."""
    found = listed(name, given, f"a list of functions, each {_OBJECTIVE}")
    for place, own in enumerate(found):
        callable_of(f"{name}[{place}]", own, _OBJECTIVE)
    if not found:
        raise ValueError(f"{name} is empty; allowed: one or more")
    return found


def _of_agents(losses: Tensor, agents: int) -> Tensor:
    object_of("what an objective gives", losses, Tensor, f"losses [.., {agents}]")
    if not losses.ndim or losses.shape[-1] != agents:
        raise ValueError(f"an objective gives losses {list(losses.shape)}; allowed: [.., {agents}]")
    return losses


def _mean(values: Sequence[Tensor]) -> Tensor:
    return values[0] if len(values) == 1 else torch.stack(list(values)).mean(0)


def _flat(parameters: Parameters) -> tuple[_Flat, list[int]]:
    """All tensors, and the agent of each."""
    by_agent = [
        objects(f"parameters[{agent}]", of, Tensor, "tensors")
        for agent, of in enumerate(listed("parameters", parameters, "a list of lists of tensors"))
    ]
    if not by_agent or not all(by_agent):
        raise ValueError("parameters lack those of an agent; allowed: one tensor or more for each agent")
    pairs = [(value, agent) for agent, of in enumerate(by_agent) for value in of]
    return tuple(value for value, _ in pairs), [agent for _, agent in pairs]


def _by_agent(values: Sequence[Tensor], owners: list[int]) -> list[list[Tensor]]:
    return [
        [value for value, own in zip(values, owners, strict=True) if own == agent]
        for agent in range(owners[-1] + 1)
    ]
