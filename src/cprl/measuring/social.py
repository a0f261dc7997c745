"""The social metrics of whole episodes: pure functions on torch tensors.

What they take, T steps counted from 1 and N agents (at least one), any batch axes in front:
    harvest  float [..., T, N], apples bitten, at least 0; the raw harvest, never a shaped reward
    in_play  bool [..., T, N], whether the action of this very step counted: the entry at the root of a step
    played   bool [..., T], True for the steps of the episode, False for padding behind its end, so that
             episodes of unlike length fit one batch; None when all were played. Padding is never read.

What they give: float64 [...], NaN where the metric is undefined, which a count beside it tells apart.
TypeError for a wrong type, ValueError for a wrong shape or value.

Below, R_i is the sum of agent i's harvest over its episode. Sources:
[P] Perolat et al., "A multi-agent reinforcement learning model of common-pool resource appropriation" (2017);
[W] Wiatrak, "Governing the Commons with Multi-Agent Reinforcement Learning" (2019).
"""

from typing import Final

import torch
from torch import Tensor

METRICS: Final = (
    "collective_return",
    "efficiency",
    "equality",
    "sustainability",
    "survival_steps",
    "peace",
    "peacefulness",
)
"""What `summary` always holds, in this order."""


def summary(
    harvest: Tensor,
    in_play: Tensor,
    *,
    played: Tensor | None = None,
    sustainable_yield: float | Tensor | None = None,
    first_stock: float | Tensor | None = None,
) -> dict[str, Tensor]:
    """All metrics by name, each float64 [...]: `METRICS`, and yield_share where a yield is given."""
    _check_steps("harvest", harvest, played)
    _check_steps("in_play", in_play, played)
    if harvest.shape != in_play.shape:
        raise ValueError(
            f"harvest is {list(harvest.shape)} and in_play {list(in_play.shape)}; equal shapes are wanted"
        )
    metrics = {
        "collective_return": collective_return(harvest, played=played),
        "efficiency": efficiency(harvest, played=played),
        "equality": equality(harvest, played=played),
        "sustainability": sustainability(harvest, played=played),
        "survival_steps": survival_steps(harvest, played=played),
        "peace": peace(in_play, played=played),
        "peacefulness": peacefulness(in_play, played=played),
    }
    if (sustainable_yield is None) != (first_stock is None):
        raise ValueError("a yield_share takes both sustainable_yield and first_stock; only one was given")
    if sustainable_yield is not None and first_stock is not None:
        metrics["yield_share"] = yield_share(
            harvest, sustainable_yield=sustainable_yield, first_stock=first_stock, played=played
        )
    return metrics


def collective_return(harvest: Tensor, *, played: Tensor | None = None) -> Tensor:
    """sum_i R_i, in apples, at least 0; what [W] calls "efficiency"."""
    return _returns(harvest, played).sum(-1)


def efficiency(harvest: Tensor, *, played: Tensor | None = None) -> Tensor:
    """sum_i R_i / T, in apples per step, at least 0 [P]; undefined for an episode without steps."""
    return collective_return(harvest, played=played) / survival_steps(harvest, played=played)


def yield_share(
    harvest: Tensor,
    *,
    sustainable_yield: float | Tensor,
    first_stock: float | Tensor,
    played: Tensor | None = None,
) -> Tensor:
    """sum_i R_i / (sustainable_yield x T + first_stock), a ratio: the harvest against what the map can bear.

    At least 0, and above 1 where the true yield is above the lower bound given. Undefined where nothing
    could be harvested.

    Args:
        sustainable_yield: apples per step that can be taken for ever; a number, or a tensor [...].
        first_stock: apples on the board as the episode begins; a number, or a tensor [...].
    """
    total = collective_return(harvest, played=played)
    per_step, first = (torch.as_tensor(n).to(total) for n in (sustainable_yield, first_stock))
    for name, number in (("sustainable_yield", per_step), ("first_stock", first)):
        if not (number >= 0).all():
            raise ValueError(f"{name} is {number.tolist()}; at least 0 is wanted")
    bearable = per_step * survival_steps(harvest, played=played) + first
    return torch.where(bearable > 0, total / bearable, torch.nan)


def equality(harvest: Tensor, *, played: Tensor | None = None) -> Tensor:
    """1 - Gini = 1 - sum_ij |R_i - R_j| / (2 N sum_i R_i), a ratio [P]; what [W] prints as "inequality".

    From 1/N, one has everything, to 1, all have the same. Undefined where nobody harvested.
    """
    returns = _returns(harvest, played)
    gaps = (returns.unsqueeze(-1) - returns.unsqueeze(-2)).abs().sum((-2, -1))
    return 1 - gaps / (2 * returns.shape[-1] * returns.sum(-1))


def equality_undefined(harvest: Tensor, *, played: Tensor | None = None) -> Tensor:
    """bool [...]: nobody harvested, so there was nothing to share; sum it to count such episodes."""
    return _returns(harvest, played).sum(-1) == 0


def sustainability(harvest: Tensor, *, played: Tensor | None = None) -> Tensor:
    """The mean, over the agents with a harvest, of E[t given r_i,t > 0], in steps, 1..T [P].

    High where apples are still there late. [P] leaves open what an agent without a harvest counts; here it
    is left out, see `agents_without_harvest`. Undefined where nobody harvested.
    """
    took = (_harvest(harvest, played) > 0).to(torch.float64)
    steps = torch.arange(1, took.shape[-2] + 1, dtype=torch.float64, device=took.device)
    mean_step = torch.einsum("t,...tn->...n", steps, took) / took.sum(-2)
    return mean_step.nanmean(-1)


def agents_without_harvest(harvest: Tensor, *, played: Tensor | None = None) -> Tensor:
    """int64 [...], 0..N: the agents that `sustainability` leaves out."""
    return (_returns(harvest, played) == 0).sum(-1)


def survival_steps(harvest: Tensor, *, played: Tensor | None = None) -> Tensor:
    """The step at which the episode ended, 0..T; what [W] calls "sustainability"."""
    _check_steps("harvest", harvest, played)
    if played is None:
        return torch.full(harvest.shape[:-2], harvest.shape[-2], dtype=torch.float64, device=harvest.device)
    return played.sum(-1, dtype=torch.float64)


def peace(in_play: Tensor, *, played: Tensor | None = None) -> Tensor:
    """(N T - agent-steps out of play) / T, in untagged agents per step, 0..N [P].

    Undefined for an episode without steps.
    """
    _check_steps("in_play", in_play, played)
    steps = in_play.shape[-2] if played is None else played.sum(-1)
    return _agent_steps_in_play(in_play, played) / steps


def peacefulness(in_play: Tensor, *, played: Tensor | None = None) -> Tensor:
    """Agent-steps in play / N, in steps, 0..T, as [W] draws it; it also falls when episodes end early."""
    return _agent_steps_in_play(in_play, played) / in_play.shape[-1]


def _returns(harvest: Tensor, played: Tensor | None) -> Tensor:
    """R_i, float64 [..., N]: a float32 sum would lose apples in a long episode."""
    return _harvest(harvest, played).sum(-2, dtype=torch.float64)


def _harvest(harvest: Tensor, played: Tensor | None) -> Tensor:
    """The harvest, checked, with padding as 0."""
    _check_steps("harvest", harvest, played)
    if played is not None:
        harvest = torch.where(played.unsqueeze(-1), harvest, 0)
    if not (harvest >= 0).all():
        raise ValueError("harvest holds a number below 0 or NaN; apples bitten are at least 0")
    return harvest


def _agent_steps_in_play(in_play: Tensor, played: Tensor | None) -> Tensor:
    """float64 [...]: the sum of in_play over steps and agents, padding left out."""
    _check_steps("in_play", in_play, played)
    counted = in_play if played is None else in_play & played.unsqueeze(-1)
    return counted.sum((-2, -1), dtype=torch.float64)


def _check_steps(name: str, steps: Tensor, played: Tensor | None) -> None:
    """That `harvest` or `in_play` is of the wanted type and shape, and that `played` fits it."""
    wanted = "float" if name == "harvest" else "bool"
    _check_type(name, steps, wanted)
    if steps.ndim < 2 or steps.shape[-1] == 0:
        raise ValueError(f"{name} is {list(steps.shape)}; [..., T, N] with at least one agent is wanted")
    if played is None:
        return
    _check_type("played", played, "bool")
    if played.shape != steps.shape[:-1]:
        raise ValueError(
            f"played is {list(played.shape)} and {name} {list(steps.shape)}; "
            f"played is wanted as {list(steps.shape[:-1])}"
        )
    if (played[..., 1:] & ~played[..., :-1]).any():
        raise ValueError(
            "played turns True again; True up to the episode's end and False behind it is wanted"
        )


def _check_type(name: str, values: object, wanted: str) -> None:
    if not isinstance(values, Tensor):
        raise TypeError(f"{name} is a {type(values).__name__}; a torch tensor of {wanted} is wanted")
    if not (values.is_floating_point() if wanted == "float" else values.dtype == torch.bool):
        raise TypeError(f"{name} is a tensor of {values.dtype}; {wanted} is wanted")
