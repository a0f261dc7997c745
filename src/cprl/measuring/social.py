"""The social metrics of whole episodes: pure functions on torch tensors.

All are functions of an episode's totals (`Totals`), with N agents (at least one), steps counted from 1, and
any leading batch axes. Results are float64 [...], NaN where the metric is undefined.

Below, R_i is the sum of agent i's harvest over its episode, T the number of steps. Sources:
[P] Perolat et al., "A multi-agent reinforcement learning model of common-pool resource appropriation" (2017);
[W] Wiatrak, "Governing the Commons with Multi-Agent Reinforcement Learning" (2019).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import torch
from torch import Tensor

SHARE: Final = "0 to 1"
"""In place of a unit."""


_NONE: Any = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Totals:
    """What an episode adds up to, float64 [..., N] of each agent; None where the game does not report the
    entry."""

    steps: Tensor = _NONE
    """T, float64 [...]."""
    harvest: Tensor = _NONE
    """R_i, the raw harvest and never a shaped reward, in apples, at least 0."""
    harvest_steps: Tensor = _NONE
    """The number of steps in which the agent harvested."""
    harvest_time: Tensor = _NONE
    """The sum of the steps in which the agent harvested."""
    in_play_steps: Tensor = _NONE
    """The number of steps at whose start the agent was in play."""
    fines: Tensor = _NONE
    """What institutions took from the agent, in units of reward (an apple is 1)."""
    transfers: Tensor = _NONE
    """What they gave it."""
    violations: Tensor = _NONE
    """The number of steps in which it broke a rule."""
    counts: Mapping[str, Tensor] = _NONE
    """By the names of `cprl.institutions.COUNTS`; metrics of those that are lacking are left out."""
    tags: Tensor = _NONE
    """How often it tagged somebody."""
    groups: Any = None
    """The indices of the agents of each group of nested enterprises; each agent belongs to one."""
    sustainable_yield: Any = None
    """Apples per step that can be harvested forever; a number, or a tensor [...]."""
    first_stock: Any = None
    """Apples on the board at the start of the episode, likewise."""


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
    totals: dict[str, Any] = {"steps": played.sum(-1, dtype=torch.float64)}
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
    if (sustainable_yield is None) != (first_stock is None):
        raise ValueError("sustainable_yield and first_stock belong together; allowed: both, or neither")
    if sustainable_yield is not None and harvest is None:
        raise ValueError("sustainable_yield is given and harvest is None; allowed: both, or neither")
    totals = totals_of(harvest, in_play, played=played)
    return of_totals(replace(totals, sustainable_yield=sustainable_yield, first_stock=first_stock))


def of_totals(totals: Totals) -> dict[str, Tensor]:
    """Return the metrics of `summary` from the totals of episodes."""
    return measured(SOCIAL, totals)


def collective_return(totals: Totals) -> Tensor:
    """sum_i R_i, in apples, at least 0; what [W] calls "efficiency"."""
    return totals.harvest.sum(-1)


def efficiency(totals: Totals) -> Tensor:
    """sum_i R_i / T, in apples per step, at least 0 [P]; undefined for an episode without steps."""
    return collective_return(totals) / totals.steps


def yield_share(totals: Totals) -> Tensor:
    """sum_i R_i / (sustainable_yield x T + first_stock), a ratio: the harvest relative to what the map
    can bear in the T steps that were played.

    Of two episodes with the same harvest the shorter one has the higher share, as agents have who take all at
    once and end the episode.
    At least 0, and above 1 where the true yield exceeds the given lower bound. Undefined where nothing could
    be harvested.
    """
    bearable = totals.sustainable_yield * totals.steps + totals.first_stock
    return torch.where(bearable > 0, collective_return(totals) / bearable, torch.nan)


def equality(totals: Totals) -> Tensor:
    """1 - Gini = 1 - sum_ij |R_i - R_j| / (2 N sum_i R_i), a ratio [P]; what [W] prints as "inequality".

    From 1/N (one agent has everything) to 1 (all have the same). Undefined where no agent harvested.
    """
    return equality_of(totals.harvest)


def equality_of(incomes: Tensor) -> Tensor:
    """Return `equality` of any incomes of N agents, float64 [..., N], at least 0."""
    gaps = (incomes.unsqueeze(-1) - incomes.unsqueeze(-2)).abs().sum((-2, -1))
    return 1 - gaps / (2 * incomes.shape[-1] * incomes.sum(-1))


def sustainability(totals: Totals) -> Tensor:
    """The mean, over the agents with a harvest, of E[t given r_i,t > 0], in steps, 1..T [P].

    High where apples are still available late. [P] does not define it for agents without a harvest; here they
    are ignored, and `cprl.measuring.statistics` counts them. Undefined where no agent harvested.
    """
    return (totals.harvest_time / totals.harvest_steps).nanmean(-1)


def survival_steps(totals: Totals) -> Tensor:
    """The step at which the episode ended, 0..T; what [W] calls "sustainability"."""
    return totals.steps


def peace(totals: Totals) -> Tensor:
    """(N T - agent-steps out of play) / T, in untagged agents per step, 0..N [P].

    Undefined for an episode without steps.
    """
    return totals.in_play_steps.sum(-1) / totals.steps


def peacefulness(totals: Totals) -> Tensor:
    """Agent-steps in play / N, in steps, 0..T, as in [W]; it also falls when episodes end early."""
    in_play_steps = totals.in_play_steps
    return in_play_steps.sum(-1) / in_play_steps.shape[-1]


class Metric(NamedTuple):
    """A metric, said once: what it is called and made of, and where it says something."""

    words: str
    unit: str
    needs: tuple[str, ...]
    """Which entries of a turn it is computed from; all need to know which steps were played."""
    of: Callable[[Totals], Tensor]
    of_totals: tuple[str, ...] = ()
    """Which other totals it is computed from."""
    counted: tuple[str, ...] = ()
    """Which of `cprl.institutions.COUNTS` it is computed from; says nothing unless an institution counts
    them."""
    digits: int | None = None
    """Behind the point, in the summary of a run; None where it is not in there."""

    def is_known(self, totals: Totals) -> bool:
        """Whether all that it is computed from is given."""
        names = (*(_TOTAL_OF.get(entry, entry) for entry in self.needs), *self.of_totals)
        counts = totals.counts or {}
        return all(getattr(totals, name) is not None for name in names) and counts.keys() >= {*self.counted}


_TOTAL_OF: Final = {"in_play": "in_play_steps", "violated": "violations", "tagged_by": "tags"}
"""The totals of entries that have another name."""


def measured(metrics: Mapping[str, Metric], totals: Totals) -> dict[str, Tensor]:
    """Return those metrics by name for which all that they are computed from is given."""
    return {name: metric.of(totals) for name, metric in metrics.items() if metric.is_known(totals)}


SOCIAL: Final[Mapping[str, Metric]] = MappingProxyType(
    {
        "collective_return": Metric("collective return", "apples", ("harvest",), collective_return),
        "efficiency": Metric("efficiency", "apples per step", ("harvest",), efficiency),
        "equality": Metric("equality (1 - Gini)", SHARE, ("harvest",), equality, digits=2),
        "sustainability": Metric("sustainability", "steps", ("harvest",), sustainability, digits=1),
        "survival_steps": Metric("survival", "steps", (), survival_steps, digits=1),
        "peace": Metric("peace", "agents", ("in_play",), peace),
        "peacefulness": Metric(
            "peacefulness", "steps in play per agent", ("in_play",), peacefulness, digits=1
        ),
        "yield_share": Metric(
            "yield share of the steps played",
            "ratio",
            ("harvest",),
            yield_share,
            of_totals=("sustainable_yield", "first_stock"),
            digits=2,
        ),
    }
)
METRICS: Final = tuple(name for name in SOCIAL if name != "yield_share")
"""What `summary` holds of a game that reports harvest and in_play, in this order."""
NEEDS: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {name: metric.needs for name, metric in SOCIAL.items()}
)
"""Which entries of a turn each metric is computed from."""
