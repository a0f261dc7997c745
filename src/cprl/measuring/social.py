"""The social metrics of whole episodes: pure functions on torch tensors.

All are functions of an episode's totals (`Totals`), with N agents (at least one), steps counted from 1, and
any leading batch axes. Results are float64 [...], NaN where the metric is undefined.

Below, R_i is the sum of agent i's harvest over its episode, T the number of steps. Sources:
[P] Perolat et al., "A multi-agent reinforcement learning model of common-pool resource appropriation" (2017);
[W] Wiatrak, "Governing the Commons with Multi-Agent Reinforcement Learning" (2019).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, NamedTuple

import torch
from torch import Tensor

SHARE: Final = "0 to 1"
"""In place of a unit."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Totals:
    """What an episode adds up to; None where the game does not report the entry."""

    steps: Tensor
    """T, float64 [...]."""
    harvest: Tensor | None = None
    """R_i, the raw harvest and never a shaped reward, in apples, at least 0, float64 [..., N]."""
    harvest_steps: Tensor | None = None
    """The number of steps in which the agent harvested, float64 [..., N]."""
    harvest_time: Tensor | None = None
    """The sum of the steps in which the agent harvested, float64 [..., N]."""
    in_play_steps: Tensor | None = None
    """The number of steps at whose start the agent was in play, float64 [..., N]."""


def totals_of(harvest: Tensor | None, in_play: Tensor | None, *, played: Tensor | None = None) -> Totals:
    """Return what the steps of episodes add up to.

    Args:
        harvest: apples harvested, float [..., T, N], at least 0.
        in_play: whether the action of this step had an effect, bool [..., T, N].
        played: True for the steps of the episode and False for the padding after its end, bool [..., T], so
            that episodes of different lengths fit one batch; None if all steps were played. Padding is not
            read.

    Raises:
        ValueError: if all are None, or a harvest is below 0, NaN or infinite.
    """
    given = next((steps for steps in (harvest, in_play) if steps is not None), None)
    if played is None:
        if given is None:
            raise ValueError("harvest, in_play and played are None; allowed: at least one of them")
        played = torch.ones(given.shape[:-1], dtype=torch.bool, device=given.device)
    totals = {"steps": played.sum(-1, dtype=torch.float64)}
    if harvest is not None:
        harvest = torch.where(played.unsqueeze(-1), harvest, 0).to(torch.float64)
        if not ((harvest >= 0) & (harvest < torch.inf)).all():
            raise ValueError("harvest holds a number below 0, NaN or infinity; allowed: apples bitten")
        bites = (harvest > 0).to(torch.float64)
        times = torch.arange(1, bites.shape[-2] + 1, dtype=torch.float64, device=bites.device)
        totals["harvest"], totals["harvest_steps"] = harvest.sum(-2), bites.sum(-2)
        totals["harvest_time"] = torch.einsum("t,...tn->...n", times, bites)
    if in_play is not None:
        totals["in_play_steps"] = (in_play & played.unsqueeze(-1)).sum(-2, dtype=torch.float64)
    return Totals(**totals)


def summary(
    harvest: Tensor | None,
    in_play: Tensor | None,
    *,
    played: Tensor | None = None,
    sustainable_yield: float | Tensor | None = None,
    first_stock: float | Tensor | None = None,
) -> dict[str, Tensor]:
    """Return all metrics by name, each float64 [...]: `METRICS`, and yield_share where a yield is given.

    Without harvest or in_play, the metrics that need it (`NEEDS`) are left out; without both, `played` says
    how many steps there were. For the arguments see `totals_of` and `yield_share`.
    """
    totals = totals_of(harvest, in_play, played=played)
    return of_totals(totals, sustainable_yield=sustainable_yield, first_stock=first_stock)


def of_totals(
    totals: Totals,
    *,
    sustainable_yield: float | Tensor | None = None,
    first_stock: float | Tensor | None = None,
) -> dict[str, Tensor]:
    """Return the metrics of `summary` from the totals of episodes.

    Raises:
        ValueError: if only one of sustainable_yield and first_stock is given, or both without a harvest.
    """
    if (sustainable_yield is None) != (first_stock is None):
        raise ValueError("sustainable_yield and first_stock belong together; allowed: both, or neither")
    lacking = {name for name in ("harvest", "in_play") if getattr(totals, _TOTAL_OF[name]) is None}
    metrics = {
        name: metric.of(totals) for name, metric in _METRICS.items() if lacking.isdisjoint(metric.needs)
    }
    if sustainable_yield is not None and first_stock is not None:
        if totals.harvest is None:
            raise ValueError("sustainable_yield is given and harvest is None; allowed: both, or neither")
        metrics["yield_share"] = yield_share(
            totals, sustainable_yield=sustainable_yield, first_stock=first_stock
        )
    return metrics


def collective_return(totals: Totals) -> Tensor:
    """sum_i R_i, in apples, at least 0; what [W] calls "efficiency"."""
    return _given(totals.harvest).sum(-1)


def efficiency(totals: Totals) -> Tensor:
    """sum_i R_i / T, in apples per step, at least 0 [P]; undefined for an episode without steps."""
    return collective_return(totals) / totals.steps


def yield_share(totals: Totals, *, sustainable_yield: float | Tensor, first_stock: float | Tensor) -> Tensor:
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
    bearable = sustainable_yield * totals.steps + first_stock
    return torch.where(bearable > 0, collective_return(totals) / bearable, torch.nan)


def equality(totals: Totals) -> Tensor:
    """1 - Gini = 1 - sum_ij |R_i - R_j| / (2 N sum_i R_i), a ratio [P]; what [W] prints as "inequality".

    From 1/N (one agent has everything) to 1 (all have the same). Undefined where no agent harvested.
    """
    return equality_of(_given(totals.harvest))


def equality_of(incomes: Tensor) -> Tensor:
    """Return `equality` of any incomes of N agents, float64 [..., N], at least 0."""
    gaps = (incomes.unsqueeze(-1) - incomes.unsqueeze(-2)).abs().sum((-2, -1))
    return 1 - gaps / (2 * incomes.shape[-1] * incomes.sum(-1))


def sustainability(totals: Totals) -> Tensor:
    """The mean, over the agents with a harvest, of E[t given r_i,t > 0], in steps, 1..T [P].

    High where apples are still available late. [P] does not define it for agents without a harvest; here they
    are ignored, and `cprl.measuring.statistics` counts them. Undefined where no agent harvested.
    """
    return (_given(totals.harvest_time) / _given(totals.harvest_steps)).nanmean(-1)


def survival_steps(totals: Totals) -> Tensor:
    """The step at which the episode ended, 0..T; what [W] calls "sustainability"."""
    return totals.steps


def peace(totals: Totals) -> Tensor:
    """(N T - agent-steps out of play) / T, in untagged agents per step, 0..N [P].

    Undefined for an episode without steps.
    """
    return _given(totals.in_play_steps).sum(-1) / totals.steps


def peacefulness(totals: Totals) -> Tensor:
    """Agent-steps in play / N, in steps, 0..T, as in [W]; it also falls when episodes end early."""
    in_play_steps = _given(totals.in_play_steps)
    return in_play_steps.sum(-1) / in_play_steps.shape[-1]


class Metric(NamedTuple):
    """A metric, said once: what it is called and made of."""

    words: str
    unit: str
    needs: tuple[str, ...]
    """Which entries of a turn it is computed from; all need to know which steps were played."""
    of: Callable[[Totals], Tensor]


_METRICS: Final[Mapping[str, Metric]] = {
    "collective_return": Metric("collective return", "apples", ("harvest",), collective_return),
    "efficiency": Metric("efficiency", "apples per step", ("harvest",), efficiency),
    "equality": Metric("equality (1 - Gini)", SHARE, ("harvest",), equality),
    "sustainability": Metric("sustainability", "steps", ("harvest",), sustainability),
    "survival_steps": Metric("survival", "steps", (), survival_steps),
    "peace": Metric("peace", "agents", ("in_play",), peace),
    "peacefulness": Metric("peacefulness", "steps in play per agent", ("in_play",), peacefulness),
}
METRICS: Final = tuple(_METRICS)
"""What `summary` holds of a game that reports harvest and in_play, in this order."""
NEEDS: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {name: metric.needs for name, metric in _METRICS.items()} | {"yield_share": ("harvest",)}
)
"""Which entries of a turn each metric is computed from."""
NAMES: Final[Mapping[str, tuple[str, str]]] = MappingProxyType(
    {name: (metric.words, metric.unit) for name, metric in _METRICS.items()}
    | {"yield_share": ("yield share of the steps played", "ratio")}
)
"""The words and the unit of each metric."""
_TOTAL_OF: Final = {"harvest": "harvest", "in_play": "in_play_steps"}


def _given(total: Tensor | None) -> Tensor:
    assert total is not None
    return total
