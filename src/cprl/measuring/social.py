"""The social metrics of whole episodes: pure functions on torch tensors.

All are functions of an episode's totals (`Totals`), with N agents (at least one), steps counted from 1, and
any leading batch axes. Results are float64 [...], NaN where the metric is undefined.

Below, R_i is the sum of agent i's harvest over its episode, T the number of steps. Sources:
[P] Perolat et al., "A multi-agent reinforcement learning model of common-pool resource appropriation" (2017);
[W] Wiatrak, "Governing the Commons with Multi-Agent Reinforcement Learning" (2019).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
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
    """Return those metrics by name, float64 [...], for which all that they are computed from is given."""
    return {name: metric.of(totals) for name, metric in metrics.items() if metric.is_known(totals)}


def summary(harvest: Tensor, in_play: Tensor) -> dict[str, Tensor]:
    """Return `METRICS` by name, each float64 [...], of the T steps of episodes.

    Args:
        harvest: apples harvested, float [..., T, N], at least 0.
        in_play: whether the action of this step had an effect, bool [..., T, N].

    Raises:
        ValueError: if a harvest is below 0, NaN or infinite.
    """
    if not ((harvest >= 0) & (harvest < torch.inf)).all():
        raise ValueError("harvest holds a number below 0, NaN or infinity; allowed: apples bitten")
    bites = (harvest > 0).to(torch.float64)
    times = torch.arange(1, bites.shape[-2] + 1, dtype=torch.float64, device=bites.device)
    totals = Totals(
        steps=torch.full(bites.shape[:-2], len(times), dtype=torch.float64, device=bites.device),
        harvest=harvest.sum(-2, dtype=torch.float64),
        harvest_steps=bites.sum(-2),
        harvest_time=torch.einsum("t,...tn->...n", times, bites),
        in_play_steps=in_play.sum(-2, dtype=torch.float64),
    )
    return measured(SOCIAL, totals)


def share_of(part: Tensor, whole: Tensor) -> Tensor:
    """Return part / whole, undefined where nothing is in the whole."""
    return torch.where(whole > 0, part / whole, torch.nan)


def equality_of(incomes: Tensor) -> Tensor:
    """Return 1 - Gini of any incomes of N agents, float64 [..., N], at least 0: from 1/N (one agent has
    everything) to 1 (all have the same). Undefined where nobody has anything."""
    gaps = (incomes.unsqueeze(-1) - incomes.unsqueeze(-2)).abs().sum((-2, -1))
    return 1 - gaps / (2 * incomes.shape[-1] * incomes.sum(-1))


SOCIAL: Final[Mapping[str, Metric]] = {
    # sum_i R_i; what [W] calls "efficiency".
    "collective_return": Metric(
        "collective return", "apples", ("harvest",), lambda totals: totals.harvest.sum(-1)
    ),
    # sum_i R_i / T [P]; undefined for an episode without steps.
    "efficiency": Metric(
        "efficiency", "apples per step", ("harvest",), lambda totals: totals.harvest.sum(-1) / totals.steps
    ),
    # 1 - sum_ij |R_i - R_j| / (2 N sum_i R_i) [P]; what [W] prints as "inequality".
    "equality": Metric(
        "equality (1 - Gini)", SHARE, ("harvest",), lambda totals: equality_of(totals.harvest), digits=2
    ),
    # The mean, over the agents with a harvest, of E[t given r_i,t > 0], 1..T [P]: high where apples are
    # still there late. [P] does not define it for agents without a harvest; here they are left out, and
    # `cprl.measuring.statistics` counts them.
    "sustainability": Metric(
        "sustainability",
        "steps",
        ("harvest",),
        lambda totals: (totals.harvest_time / totals.harvest_steps).nanmean(-1),
        digits=1,
    ),
    # The step at which the episode ended, 0..T; what [W] calls "sustainability".
    "survival_steps": Metric("survival", "steps", (), lambda totals: totals.steps, digits=1),
    # (N T - agent-steps out of play) / T, in untagged agents per step, 0..N [P].
    "peace": Metric(
        "peace", "agents", ("in_play",), lambda totals: totals.in_play_steps.sum(-1) / totals.steps
    ),
    # Agent-steps in play / N, 0..T, as in [W]; it also falls when episodes end early.
    "peacefulness": Metric(
        "peacefulness",
        "steps in play per agent",
        ("in_play",),
        lambda totals: totals.in_play_steps.sum(-1) / totals.in_play_steps.shape[-1],
        digits=1,
    ),
    # sum_i R_i / (sustainable_yield x T + first_stock): the harvest relative to what the map can bear in
    # the T steps that were played. Of two episodes with the same harvest the shorter one has the higher
    # share, as agents have who take all at once and end the episode. Above 1 where the true yield exceeds
    # the given lower bound.
    "yield_share": Metric(
        "yield share of the steps played",
        "ratio",
        ("harvest",),
        lambda totals: share_of(
            totals.harvest.sum(-1), totals.sustainable_yield * totals.steps + totals.first_stock
        ),
        of_totals=("sustainable_yield", "first_stock"),
        digits=2,
    ),
}
METRICS: Final = tuple(name for name in SOCIAL if name != "yield_share")
"""Those of every game that reports harvest and in_play, in this order."""
