"""What came of the institutions of a game in whole episodes: pure functions on torch tensors.

Arguments are totals of an episode, [..., N] for N agents (at least one) and any leading batch axes, integers
or floats, at least 0; `harvest` in apples, `fines` and `transfers` in units of reward (an apple is 1), all
others are counts, by the names of `cprl.institutions.COUNTS`; violations are turns in which the agent broke a
rule.

Results are float64 [...], NaN where a metric is undefined; `cprl.measuring.statistics` counts these cases.
None is computed from a shaped reward, and the social metrics stay those of the harvest.

Sources: Ostrom, "Governing the Commons" (1990), whose principles each metric belongs to; inequality as in
`cprl.measuring.social.equality`, 1 - Gini.
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Final, NamedTuple

import torch
from torch import Tensor

from cprl.institutions import (
    COUNTS,
    Boundaries,
    ClosedPatches,
    ClosedSeason,
    GraduatedSanctions,
    Institution,
    Levies,
    Mediation,
    Monitoring,
    Quota,
    Vote,
)
from cprl.measuring import social
from cprl.measuring.social import SHARE


class Metric(NamedTuple):
    """A metric, said once: what it is called and made of, and where it says something."""

    words: str
    unit: str
    needs: tuple[str, ...]
    """Which entries of a turn it is computed from."""
    kinds: tuple[type[Institution], ...] = ()
    """The institutions without which it says nothing; empty for one that concerns every institution."""
    counted: tuple[str, ...] = ()
    """Which of `cprl.institutions.COUNTS` it is computed from."""


_NET: Final = ("harvest", "fines", "transfers")
_COUNTS: Final = ("counts",)
_GROUPS: Final = (Levies,)
METRICS: Final[Mapping[str, Metric]] = MappingProxyType(
    {
        "fines": Metric("fines of all", "apples", ("fines",)),
        "transfers": Metric("transfers to all", "apples", ("transfers",)),
        "violations": Metric("violations", "turns", ("violated",)),
        "violations_per_step": Metric("violations per turn in play", SHARE, ("violated", "in_play")),
        "trespasses": Metric("trespasses", "turns", _COUNTS, (Boundaries,), ("trespasses",)),
        "excess_bites": Metric("taken above a quota", "bites", _COUNTS, (Quota,), ("excess_bites",)),
        "closed_bites": Metric(
            "taken in closed seasons and patches",
            "bites",
            _COUNTS,
            (ClosedSeason, ClosedPatches),
            ("closed_bites",),
        ),
        "own_share_of_bites": Metric(
            "bites where one may bite", SHARE, _COUNTS, (Boundaries,), ("own_bites", "foreign_bites")
        ),
        "detection_rate": Metric(
            "violations detected", SHARE, _COUNTS, (Monitoring,), ("detections", "violations")
        ),
        "recidivism": Metric(
            "violations after a sanction",
            SHARE,
            _COUNTS,
            (GraduatedSanctions,),
            ("returns_to_violation", "violations"),
        ),
        "sanctions_per_violation": Metric(
            "sanctions per violation", "ratio", _COUNTS, (GraduatedSanctions,), ("sanctions", "violations")
        ),
        "unjust_share_of_tags": Metric(
            "unjust tags", SHARE, ("counts", "tagged_by"), (Mediation,), ("unjust_tags",)
        ),
        "net_equality": Metric("equality of net incomes", SHARE, _NET),
        "equality_within": Metric("equality within groups", SHARE, ("harvest",), _GROUPS),
        "equality_between": Metric("equality between groups", SHARE, ("harvest",), _GROUPS),
        "net_equality_within": Metric("equality of net incomes within groups", SHARE, _NET, _GROUPS),
        "net_equality_between": Metric("equality of net incomes between groups", SHARE, _NET, _GROUPS),
    }
)

Groups = Sequence[Sequence[int]]
"""The indices of the agents of each group; each agent belongs to one group."""

_ROUNDING: Final = 1e-6
"""The share of all an agent got and gave below which its net income is 0: payments are float32."""


def metrics_for(institutions: Sequence[Institution]) -> tuple[str, ...]:
    """The metrics that say something of a game with these institutions; of a game with none, whose entries
    are somebody's own, all but those of groups."""
    if not institutions:
        return tuple(name for name, metric in METRICS.items() if metric.kinds != _GROUPS)
    voted_on = [institution.on for institution in institutions if isinstance(institution, Vote)]
    return tuple(
        name
        for name, metric in METRICS.items()
        if not metric.kinds
        or any(isinstance(institution, metric.kinds) for institution in (*institutions, *voted_on))
    )


def counts_for(institutions: Sequence[Institution]) -> tuple[str, ...]:
    """The names of `cprl.institutions.COUNTS` that say something of a game with these institutions; of a game
    with none, whose entries are somebody's own, all."""
    needed = {name for metric in metrics_for(institutions) for name in METRICS[metric].counted}
    return tuple(name for name in COUNTS if name == "violations" or name in needed)


def groups_of(institutions: Sequence[Institution]) -> Groups | None:
    """The groups of nested enterprises, those of the first `Levies`; None without one."""
    return next((one.groups for one in institutions if isinstance(one, Levies)), None)


def summary(
    *,
    harvest: Tensor | None = None,
    fines: Tensor | None = None,
    transfers: Tensor | None = None,
    violations: Tensor | None = None,
    counts: Mapping[str, Tensor] | None = None,
    in_play_steps: Tensor | None = None,
    tags: Tensor | None = None,
    groups: Groups | None = None,
) -> dict[str, Tensor]:
    """Those of `METRICS` by name whose arguments are given, each float64 [...].

    Args:
        harvest: apples of each agent.
        fines: what institutions took from it.
        transfers: what they gave it.
        violations: turns in which it broke a rule.
        counts: by the names of `cprl.institutions.COUNTS`; metrics of those that are lacking are left out.
        in_play_steps: turns in which it was in play.
        tags: how often it tagged somebody.
        groups: agents that belong together, for the metrics of groups.
    """
    metrics: dict[str, Tensor] = {}
    for name, values in (("fines", fines), ("transfers", transfers), ("violations", violations)):
        if values is not None:
            metrics[name] = total(values)
    if violations is not None and in_play_steps is not None:
        metrics["violations_per_step"] = violations_per_step(violations, in_play_steps)
    if counts is not None:
        totals = ("trespasses", "excess_bites", "closed_bites")
        metrics |= {name: total(counts[name]) for name in totals if name in counts}
        for name, ratio in _RATIOS.items():
            if counts.keys() >= set(METRICS[name].counted):
                metrics[name] = ratio(*(counts[count] for count in METRICS[name].counted))
        if tags is not None and "unjust_tags" in counts:
            metrics["unjust_share_of_tags"] = unjust_share_of_tags(counts["unjust_tags"], tags)
    incomes = {} if harvest is None else {"": harvest}
    if harvest is not None and fines is not None and transfers is not None:
        incomes["net_"] = net_income(harvest, fines, transfers)
        metrics["net_equality"] = equality(incomes["net_"])
    if groups is not None:
        for kind, income in incomes.items():
            metrics[f"{kind}equality_within"] = equality_within(income, groups).nanmean(-1)
            metrics[f"{kind}equality_between"] = equality_between(income, groups)
    return {name: metrics[name] for name in METRICS if name in metrics}


def total(values: Tensor) -> Tensor:
    """sum_i x_i of any of the arguments: fines, transfers, trespasses and so on."""
    return values.sum(-1, dtype=torch.float64)


def own_share_of_bites(own_bites: Tensor, foreign_bites: Tensor) -> Tensor:
    """sum own_bites / (sum own_bites + sum foreign_bites), 0..1: principle 1, boundaries.

    The share of bites in places that the agent may use, those open to all included. Undefined without a bite.
    """
    allowed = total(own_bites)
    return _ratio(allowed, allowed + total(foreign_bites))


def violations_per_step(violations: Tensor, in_play_steps: Tensor) -> Tensor:
    """sum violations / sum in_play_steps, 0..1: the share of agents' turns in play in which one broke a rule.

    Undefined if nobody was in play.
    """
    return _ratio(total(violations), total(in_play_steps))


def detection_rate(detections: Tensor, violations: Tensor) -> Tensor:
    """sum detections / sum violations: principle 4, monitoring; near p of `Monitoring`.

    Undefined without a violation.
    """
    return _ratio(total(detections), total(violations))


def recidivism(returns_to_violation: Tensor, violations: Tensor) -> Tensor:
    """sum returns_to_violation / sum violations, 0..1: principle 5, graduated sanctions.

    The share of turns with a violation by agents who were sanctioned before in the same episode. Undefined
    without a violation.
    """
    return _ratio(total(returns_to_violation), total(violations))


def sanctions_per_violation(sanctions: Tensor, violations: Tensor) -> Tensor:
    """sum sanctions / sum violations: principle 5, graduated sanctions.

    Above 1 where tags are sanctioned too. Undefined without a violation.
    """
    return _ratio(total(sanctions), total(violations))


_RATIOS: Final = {
    "own_share_of_bites": own_share_of_bites,
    "detection_rate": detection_rate,
    "recidivism": recidivism,
    "sanctions_per_violation": sanctions_per_violation,
}


def unjust_share_of_tags(unjust_tags: Tensor, tags: Tensor) -> Tensor:
    """sum unjust_tags / sum tags, 0..1: principle 6, conflict resolution; undefined without a tag."""
    return _ratio(total(unjust_tags), total(tags))


def net_income(harvest: Tensor, fines: Tensor, transfers: Tensor) -> Tensor:
    """harvest - fines + transfers of each agent, float64 [..., N]; below 0 where fines exceed all else.

    Payments are float32: what they leave by rounding alone, a millionth of all three, is 0.
    """
    harvest, fines, transfers = (part.to(torch.float64) for part in (harvest, fines, transfers))
    income = harvest - fines + transfers
    return torch.where(income.abs() <= _ROUNDING * (harvest + fines + transfers), 0.0, income)


def equality(income: Tensor) -> Tensor:
    """1 - Gini of incomes [..., N], see `cprl.measuring.social.equality`, e.g. of `net_income`.

    From 1/N (one agent has everything) to 1 (all have the same). Undefined where nobody has anything, and
    where somebody has less than nothing, since the Gini coefficient then has no bounds.
    """
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


def _ratio(part: Tensor, whole: Tensor) -> Tensor:
    return torch.where(whole > 0, part / whole, torch.nan)
