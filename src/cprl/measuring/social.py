"""The social metrics of whole episodes: pure functions on torch tensors.

Arguments, for T steps counted from 1 and N agents (at least one), with any leading batch axes:
    harvest  float [..., T, N], apples harvested, at least 0; the raw harvest, never a shaped reward
    in_play  bool [..., T, N], whether the action of this step had an effect: the entry at the root of a step
    played   bool [..., T], True for the steps of the episode and False for the padding after its end, so that
             episodes of different lengths fit one batch; None if all steps were played. Padding is not read.

Results are float64 [...], NaN where the metric is undefined; separate functions count these cases.
A wrong type, shape or value raises ValueError; the message says what is allowed.

Below, R_i is the sum of agent i's harvest over its episode. Sources:
[P] Perolat et al., "A multi-agent reinforcement learning model of common-pool resource appropriation" (2017);
[W] Wiatrak, "Governing the Commons with Multi-Agent Reinforcement Learning" (2019).
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

import torch
from torch import Tensor

from cprl.arguments import refusal

NEEDS: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {
        "collective_return": ("harvest",),
        "efficiency": ("harvest",),
        "equality": ("harvest",),
        "sustainability": ("harvest",),
        "survival_steps": (),
        "peace": ("in_play",),
        "peacefulness": ("in_play",),
        "yield_share": ("harvest",),
    }
)
"""Which entries of a turn each metric is computed from; all need to know which steps were played."""

METRICS: Final = tuple(name for name in NEEDS if name != "yield_share")
"""What `summary` holds of a game that reports harvest and in_play, in this order."""


def summary(
    harvest: Tensor | None,
    in_play: Tensor | None,
    *,
    played: Tensor | None = None,
    sustainable_yield: float | Tensor | None = None,
    first_stock: float | Tensor | None = None,
) -> dict[str, Tensor]:
    """All metrics by name, each float64 [...]: `METRICS`, and yield_share where a yield is given.

    Without harvest or in_play, the metrics that need it (`NEEDS`) are left out; without both, `played` says
    how many steps there were.
    """
    for name, steps in (("harvest", harvest), ("in_play", in_play)):
        if steps is not None:
            _check_steps(name, steps, played)
    if played is not None:
        _check_played(played)
    if harvest is not None and in_play is not None and harvest.shape != in_play.shape:
        raise ValueError(
            f"harvest is {list(harvest.shape)} and in_play is {list(in_play.shape)}; allowed: equal shapes"
        )
    metrics: dict[str, Tensor] = {}
    if harvest is not None:
        metrics["collective_return"] = collective_return(harvest, played=played)
        metrics["efficiency"] = efficiency(harvest, played=played)
        metrics["equality"] = equality(harvest, played=played)
        metrics["sustainability"] = sustainability(harvest, played=played)
    metrics["survival_steps"] = _steps_played(in_play if harvest is None else harvest, played)
    if in_play is not None:
        metrics["peace"] = peace(in_play, played=played)
        metrics["peacefulness"] = peacefulness(in_play, played=played)
    if (sustainable_yield is None) != (first_stock is None):
        given = "sustainable_yield" if first_stock is None else "first_stock"
        raise ValueError(
            f"only {given} is given; allowed: both sustainable_yield and first_stock, or neither"
        )
    if sustainable_yield is not None and first_stock is not None:
        if harvest is None:
            raise ValueError("sustainable_yield is given and harvest is None; allowed: both, or neither")
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
    """sum_i R_i / (sustainable_yield x T + first_stock), a ratio: the harvest relative to what the map
    can bear in the T steps that were played.

    Of two episodes with the same harvest the shorter one has the higher share, as agents have who take all at
    once and end the episode.
    At least 0, and above 1 where the true yield exceeds the given lower bound. Undefined where nothing could
    be harvested.

    Args:
        sustainable_yield: Apples per step that can be harvested forever; a number, or a tensor [...].
        first_stock: Apples on the board at the start of the episode; a number, or a tensor [...].
    """
    total = collective_return(harvest, played=played)
    per_step = _yield_number("sustainable_yield", sustainable_yield, total)
    first = _yield_number("first_stock", first_stock, total)
    bearable = per_step * survival_steps(harvest, played=played) + first
    return torch.where(bearable > 0, total / bearable, torch.nan)


def equality(harvest: Tensor, *, played: Tensor | None = None) -> Tensor:
    """1 - Gini = 1 - sum_ij |R_i - R_j| / (2 N sum_i R_i), a ratio [P]; what [W] prints as "inequality".

    From 1/N (one agent has everything) to 1 (all have the same). Undefined where no agent harvested.
    """
    returns = _returns(harvest, played)
    gaps = (returns.unsqueeze(-1) - returns.unsqueeze(-2)).abs().sum((-2, -1))
    return 1 - gaps / (2 * returns.shape[-1] * returns.sum(-1))


def sustainability(harvest: Tensor, *, played: Tensor | None = None) -> Tensor:
    """The mean, over the agents with a harvest, of E[t given r_i,t > 0], in steps, 1..T [P].

    High where apples are still available late. [P] does not define it for agents without a harvest; here they
    are ignored, and `cprl.measuring.replicas` counts them. Undefined where no agent harvested.
    """
    took = (_harvest(harvest, played) > 0).to(torch.float64)
    steps = torch.arange(1, took.shape[-2] + 1, dtype=torch.float64, device=took.device)
    mean_step = torch.einsum("t,...tn->...n", steps, took) / took.sum(-2)
    return mean_step.nanmean(-1)


def survival_steps(harvest: Tensor, *, played: Tensor | None = None) -> Tensor:
    """The step at which the episode ended, 0..T; what [W] calls "sustainability"."""
    _check_steps("harvest", harvest, played)
    return _steps_played(harvest, played)


def peace(in_play: Tensor, *, played: Tensor | None = None) -> Tensor:
    """(N T - agent-steps out of play) / T, in untagged agents per step, 0..N [P].

    Undefined for an episode without steps.
    """
    _check_steps("in_play", in_play, played)
    steps = in_play.shape[-2] if played is None else played.sum(-1)
    return _agent_steps_in_play(in_play, played) / steps


def peacefulness(in_play: Tensor, *, played: Tensor | None = None) -> Tensor:
    """Agent-steps in play / N, in steps, 0..T, as in [W]; it also falls when episodes end early."""
    return _agent_steps_in_play(in_play, played) / in_play.shape[-1]


def _steps_played(steps: Tensor | None, played: Tensor | None) -> Tensor:
    """float64 [...]: the steps of each episode, of those in `played`, else of all in [..., T, N]."""
    if played is not None:
        return played.sum(-1, dtype=torch.float64)
    if steps is None:
        raise ValueError("harvest, in_play and played are None; allowed: at least one of them")
    return torch.full(steps.shape[:-2], steps.shape[-2], dtype=torch.float64, device=steps.device)


def _returns(harvest: Tensor, played: Tensor | None) -> Tensor:
    """R_i, float64 [..., N], because a float32 sum would lose apples in a long episode."""
    return _harvest(harvest, played).sum(-2, dtype=torch.float64)


def _harvest(harvest: Tensor, played: Tensor | None) -> Tensor:
    """The harvest, checked, with padding set to 0."""
    _check_steps("harvest", harvest, played)
    if played is not None:
        harvest = torch.where(played.unsqueeze(-1), harvest, 0)
    if not ((harvest >= 0) & (harvest < torch.inf)).all():
        raise ValueError(
            "harvest holds a number below 0, NaN or infinity; allowed: apples bitten, at least 0"
        )
    return harvest


def _agent_steps_in_play(in_play: Tensor, played: Tensor | None) -> Tensor:
    """float64 [...]: the sum of in_play over steps and agents, without padding."""
    _check_steps("in_play", in_play, played)
    counted = in_play if played is None else in_play & played.unsqueeze(-1)
    return counted.sum((-2, -1), dtype=torch.float64)


def _yield_number(name: str, values: float | Tensor, total: Tensor) -> Tensor:
    """A number, or a tensor that fits the batch axes of `total`, in float64: float32 would round it.

    Raises:
        ValueError: If it is anything else, below 0 or not finite.
    """
    allowed = f"a finite number >= 0, or a tensor of them that fits {list(total.shape)}"
    try:
        numbers = torch.as_tensor(values, dtype=torch.float64, device=total.device)
        fits = numbers.expand_as(total).shape == total.shape
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise refusal(name, values, allowed) from None
    if not fits or isinstance(values, bool) or not ((numbers >= 0) & (numbers < torch.inf)).all():
        raise refusal(name, values, allowed)
    return numbers


def _check_steps(name: str, steps: Tensor, played: Tensor | None) -> None:
    """Checks the type and shape of `harvest` or `in_play`, and that `played` fits it."""
    _check_type(name, steps, "float" if name == "harvest" else "bool")
    if steps.ndim < 2 or steps.shape[-1] == 0:
        raise ValueError(f"{name} is {list(steps.shape)}; allowed: [..., T, N] with at least one agent")
    if played is None:
        return
    _check_played(played)
    if played.shape != steps.shape[:-1]:
        raise ValueError(
            f"played is {list(played.shape)} and {name} is {list(steps.shape)}; "
            f"allowed: played {list(steps.shape[:-1])}"
        )


def _check_played(played: Tensor) -> None:
    """Checks that `played` is True up to the end of each episode, and False after it."""
    _check_type("played", played, "bool")
    if played.ndim < 1:
        raise ValueError("played is []; allowed: [..., T]")
    if (played[..., 1:] & ~played[..., :-1]).any():
        raise ValueError(
            "played turns True again; allowed: True up to the end of the episode, and False after it"
        )


def _check_type(name: str, values: object, kind: str) -> None:
    if not isinstance(values, Tensor):
        raise ValueError(f"{name} is a {type(values).__name__}; allowed: a torch tensor of {kind}")
    if not (values.is_floating_point() if kind == "float" else values.dtype == torch.bool):
        raise ValueError(f"{name} is a tensor of {values.dtype}; allowed: {kind}")
