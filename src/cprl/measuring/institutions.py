"""What came of the institutions of a game in whole episodes: pure functions on torch tensors.

All are functions of an episode's totals, `cprl.measuring.social.Totals`. Results are float64 [...], NaN where
a metric is undefined; `cprl.measuring.statistics` counts these cases. None is computed from a shaped reward,
and the social metrics stay those of the harvest.

Sources: Ostrom, "Governing the Commons" (1990), whose principles each metric belongs to; inequality as in
`cprl.measuring.social`, 1 - Gini.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Final

import torch
from torch import Tensor

from cprl.institutions import COUNTS, Institution, Levies
from cprl.measuring import social
from cprl.measuring.social import SHARE, Metric, Totals

Groups = Sequence[Sequence[int]]
"""The indices of the agents of each group; each agent belongs to one group."""

_INCOMES: Final = ("harvest", "fines", "transfers")
_ROUNDING: Final = 1e-6
"""The share of all an agent got and gave below which its net income is 0: payments are float32."""


def net_income(harvest: Tensor, fines: Tensor, transfers: Tensor) -> Tensor:
    """harvest - fines + transfers of each agent, float64 [..., N]; below 0 where fines exceed all else.

    Payments are float32: what they leave by rounding alone, a millionth of all three, is 0.
    """
    harvest, fines, transfers = (part.to(torch.float64) for part in (harvest, fines, transfers))
    income = harvest - fines + transfers
    return torch.where(income.abs() <= _ROUNDING * (harvest + fines + transfers), 0.0, income)


def equality(income: Tensor) -> Tensor:
    """`cprl.measuring.social.equality_of` incomes [..., N], e.g. of `net_income`; undefined also where
    somebody has less than nothing, since the Gini coefficient then has no bounds."""
    income = income.to(torch.float64)
    value = social.equality_of(income.clamp(min=0.0))
    return torch.where((income < 0).any(-1), torch.nan, value)


def equality_within(income: Tensor, groups: Groups) -> Tensor:
    """`equality` within each of G groups, float64 [..., G]: principle 8, nested enterprises."""
    return torch.stack([equality(income[..., list(group)]) for group in groups], -1)


def equality_between(income: Tensor, groups: Groups) -> Tensor:
    """`equality` of the groups' mean incomes, each group counted once: principle 8, nested enterprises."""
    income = income.to(torch.float64)
    return equality(torch.stack([income[..., list(group)].mean(-1) for group in groups], -1))


def _total(values: Tensor) -> Tensor:
    return values.sum(-1, dtype=torch.float64)


def _ratio(part: Tensor, whole: Tensor) -> Tensor:
    """sum_i x_i / sum_i y_i; undefined where nothing is in the whole."""
    return social.share_of(_total(part), _total(whole))


def _net(totals: Totals) -> Tensor:
    return net_income(totals.harvest, totals.fines, totals.transfers)


def _within(income: Tensor, groups: Groups) -> Tensor:
    return equality_within(income, groups).nanmean(-1)


def _sum(words: str, unit: str, entry: str, total: str) -> Metric:
    return Metric(words, unit, (entry,), lambda sums: _total(getattr(sums, total)))


def _count(words: str, unit: str, name: str) -> Metric:
    """The sum of one of `COUNTS`."""
    return Metric(words, unit, ("counts",), lambda sums: _total(sums.counts[name]), counted=(name,))


def _per_violation(words: str, name: str, *, unit: str = SHARE) -> Metric:
    """The sum of one of `COUNTS` for each violation; undefined without one."""
    names = (name, "violations")
    return Metric(
        words, unit, ("counts",), lambda sums: _ratio(*(sums.counts[one] for one in names)), counted=names
    )


def _of_groups(words: str, of: Callable[[Tensor, Groups], Tensor], *, is_net: bool = False) -> Metric:
    """Principle 8, nested enterprises: of the harvest or of net incomes."""
    return Metric(
        words,
        SHARE,
        _INCOMES if is_net else ("harvest",),
        lambda sums: of(_net(sums) if is_net else sums.harvest, sums.groups),
        of_totals=("groups",),
    )


METRICS: Final[Mapping[str, Metric]] = {
    "fines": _sum("fines of all", "apples", "fines", "fines"),
    "transfers": _sum("transfers to all", "apples", "transfers", "transfers"),
    "violations": _sum("violations", "turns", "violated", "violations"),
    "violations_per_step": Metric(
        "violations per turn in play",
        SHARE,
        ("violated", "in_play"),
        lambda sums: _ratio(sums.violations, sums.in_play_steps),
    ),
    "trespasses": _count("trespasses", "turns", "trespasses"),
    "excess_bites": _count("taken above a quota", "bites", "excess_bites"),
    "closed_bites": _count("taken while closed", "bites", "closed_bites"),
    # Principle 1, boundaries: bites where the agent may bite, places that are open to all included.
    "own_share_of_bites": Metric(
        "bites where one may bite",
        SHARE,
        ("counts",),
        lambda sums: _ratio(
            sums.counts["own_bites"], sums.counts["own_bites"] + sums.counts["foreign_bites"]
        ),
        counted=("own_bites", "foreign_bites"),
    ),
    # Principle 4, monitoring: near p of `Monitoring`.
    "detection_rate": _per_violation("violations detected", "detections"),
    # Principle 5, graduated sanctions: violations by agents who were sanctioned before in the episode.
    "recidivism": _per_violation("violations after a sanction", "returns_to_violation"),
    # Above 1 where tags are sanctioned too.
    "sanctions_per_violation": _per_violation("sanctions per violation", "sanctions", unit="ratio"),
    # Principle 6, conflict resolution; undefined without a tag.
    "unjust_share_of_tags": Metric(
        "unjust tags",
        SHARE,
        ("counts", "tagged_by"),
        lambda sums: _ratio(sums.counts["unjust_tags"], sums.tags),
        counted=("unjust_tags",),
    ),
    "net_equality": Metric("equality of net incomes", SHARE, _INCOMES, lambda sums: equality(_net(sums))),
    "equality_within": _of_groups("equality within groups", _within),
    "equality_between": _of_groups("equality between groups", equality_between),
    "net_equality_within": _of_groups("equality of net incomes within groups", _within, is_net=True),
    "net_equality_between": _of_groups(
        "equality of net incomes between groups", equality_between, is_net=True
    ),
}


def metrics_for(institutions: Sequence[Institution]) -> tuple[str, ...]:
    """The metrics that say something of a game with these institutions; of a game with none, whose entries
    are somebody's own, all but those of groups."""
    if not institutions:
        return tuple(name for name, metric in METRICS.items() if "groups" not in metric.of_totals)
    counted = {"violations", *(count for institution in institutions for count in institution.rule.counts)}
    return tuple(
        name
        for name, metric in METRICS.items()
        if counted.issuperset(metric.counted)
        and ("groups" not in metric.of_totals or groups_of(institutions) is not None)
    )


def counts_for(institutions: Sequence[Institution]) -> tuple[str, ...]:
    """The names of `cprl.institutions.COUNTS` that say something of a game with these institutions; of a game
    with none, whose entries are somebody's own, all."""
    needed = {name for metric in metrics_for(institutions) for name in METRICS[metric].counted}
    return tuple(name for name in COUNTS if name == "violations" or name in needed)


def groups_of(institutions: Sequence[Institution]) -> Groups | None:
    """The groups of nested enterprises, those of the first `Levies`; None without one."""
    return next((one.groups for one in institutions if isinstance(one, Levies)), None)
