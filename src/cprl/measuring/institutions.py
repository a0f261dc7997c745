"""What came of the institutions of a game in whole episodes: pure functions on torch tensors.

Arguments are totals of an episode, [..., N] for N agents (at least one) and any leading batch axes, integers
or floats, at least 0; `harvest` in apples, `fines` and `transfers` in units of reward (an apple is 1), all
others are counts, by the names of `cprl.institutions.COUNTS`; violations are turns in which the agent broke a
rule.

Results are float64 [...], NaN where a metric is undefined; `cprl.measuring.replicas` counts these cases. None
is computed from a shaped reward, and the social metrics stay those of the harvest. A wrong type, shape or
value raises ValueError; the message says what is allowed.

Sources: Ostrom, "Governing the Commons" (1990), whose principles each metric belongs to; inequality as in
`cprl.measuring.social.equality`, 1 - Gini.
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Final

import torch
from torch import Tensor

from cprl.arguments import integer, listed, objects, refusal
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

NEEDS: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {
        "fines": ("fines",),
        "transfers": ("transfers",),
        "violations": ("violated",),
        "violations_per_step": ("violated", "in_play"),
        "trespasses": ("counts",),
        "excess_bites": ("counts",),
        "closed_bites": ("counts",),
        "own_share_of_bites": ("counts",),
        "detection_rate": ("counts",),
        "recidivism": ("counts",),
        "sanctions_per_violation": ("counts",),
        "unjust_share_of_tags": ("counts", "tagged_by"),
        "net_equality": ("harvest", "fines", "transfers"),
        "equality_within": ("harvest",),
        "equality_between": ("harvest",),
        "net_equality_within": ("harvest", "fines", "transfers"),
        "net_equality_between": ("harvest", "fines", "transfers"),
    }
)
"""Which entries of a turn each metric is computed from."""

OF_GROUPS: Final = tuple(name for name in NEEDS if name.endswith(("_within", "_between")))
"""The metrics that need to know which agents belong together."""

KINDS: Final[Mapping[str, tuple[type[Institution], ...]]] = MappingProxyType(
    {
        "trespasses": (Boundaries,),
        "own_share_of_bites": (Boundaries,),
        "excess_bites": (Quota,),
        "closed_bites": (ClosedSeason, ClosedPatches),
        "detection_rate": (Monitoring,),
        "recidivism": (GraduatedSanctions,),
        "sanctions_per_violation": (GraduatedSanctions,),
        "unjust_share_of_tags": (Mediation,),
        **dict.fromkeys(OF_GROUPS, (Levies,)),
    }
)
"""The institutions without which a metric says nothing; all others concern every institution."""

COUNTED: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {
        "trespasses": ("trespasses",),
        "excess_bites": ("excess_bites",),
        "closed_bites": ("closed_bites",),
        "own_share_of_bites": ("own_bites", "foreign_bites"),
        "detection_rate": ("detections", "violations"),
        "recidivism": ("returns_to_violation", "violations"),
        "sanctions_per_violation": ("sanctions", "violations"),
        "unjust_share_of_tags": ("unjust_tags",),
    }
)
"""Which of `cprl.institutions.COUNTS` each metric is computed from."""

Groups = Sequence[Sequence[int]]
"""The indices of the agents of each group; each agent belongs to one group."""

_ROUNDING: Final = 1e-6
"""The share of all an agent got and gave below which its net income is 0: payments are float32."""


def metrics_for(institutions: Sequence[Institution]) -> tuple[str, ...]:
    """The metrics of `NEEDS` that say something of a game with these institutions; of a game with none, whose
    entries are somebody's own, all but those of groups."""
    found = objects("institutions", institutions, Institution, "a value of cprl.institutions")
    if not found:
        return tuple(name for name in NEEDS if name not in OF_GROUPS)
    there = (*found, *(own.on for own in found if isinstance(own, Vote)))
    return tuple(
        name for name in NEEDS if name not in KINDS or any(isinstance(own, KINDS[name]) for own in there)
    )


def counts_for(institutions: Sequence[Institution]) -> tuple[str, ...]:
    """The names of `cprl.institutions.COUNTS` that say something of a game with these institutions; of a game
    with none, whose entries are somebody's own, all."""
    needed = {name for metric in metrics_for(institutions) for name in COUNTED.get(metric, ())}
    return tuple(name for name in COUNTS if name == "violations" or name in needed)


def groups_of(institutions: Sequence[Institution]) -> Groups | None:
    """The groups of nested enterprises, those of the first `Levies`; None without one."""
    found = objects("institutions", institutions, Institution, "a value of cprl.institutions")
    return next((own.groups for own in found if isinstance(own, Levies)), None)


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
    """Those metrics of `NEEDS` by name whose arguments are given, each float64 [...].

    Args:
        harvest: apples of each agent.
        fines: what institutions took from it.
        transfers: what they gave it.
        violations: turns in which it broke a rule.
        counts: by the names of `cprl.institutions.COUNTS`; metrics of those that are lacking are left out.
        in_play_steps: turns in which it was in play.
        tags: how often it tagged somebody.
        groups: agents that belong together, for `OF_GROUPS`.
    """
    found: dict[str, Tensor] = {}
    for name, values in (("fines", fines), ("transfers", transfers), ("violations", violations)):
        if values is not None:
            found[name] = total(name, values)
    if violations is not None and in_play_steps is not None:
        found["violations_per_step"] = violations_per_step(violations, in_play_steps)
    if counts is not None:
        totals = ("trespasses", "excess_bites", "closed_bites")
        found |= {name: total(name, counts[name]) for name in totals if name in counts}
        for name, ratio in _RATIOS.items():
            if counts.keys() >= set(COUNTED[name]):
                found[name] = ratio(*(counts[count] for count in COUNTED[name]))
        if tags is not None and "unjust_tags" in counts:
            found["unjust_share_of_tags"] = unjust_share_of_tags(counts["unjust_tags"], tags)
    incomes = {} if harvest is None else {"": harvest}
    if harvest is not None and fines is not None and transfers is not None:
        incomes["net_"] = net_income(harvest, fines, transfers)
        found["net_equality"] = equality(incomes["net_"])
    if groups is not None:
        for kind, income in incomes.items():
            found[f"{kind}equality_within"] = equality_within(income, groups).nanmean(-1)
            found[f"{kind}equality_between"] = equality_between(income, groups)
    return {name: found[name] for name in NEEDS if name in found}


def total(name: str, values: Tensor) -> Tensor:
    """sum_i x_i of any of the arguments: fines, transfers, trespasses and so on; `name` is for messages."""
    return _checked(name, values).sum(-1)


def own_share_of_bites(own_bites: Tensor, foreign_bites: Tensor) -> Tensor:
    """sum own_bites / (sum own_bites + sum foreign_bites), 0..1: principle 1, boundaries.

    The share of bites in places that the agent may use, those open to all included. Undefined without a bite.
    """
    own = total("own_bites", own_bites)
    return _ratio(own, own + total("foreign_bites", foreign_bites))


def violations_per_step(violations: Tensor, in_play_steps: Tensor) -> Tensor:
    """sum violations / sum in_play_steps, 0..1: the share of agents' turns in play in which one broke a rule.

    Undefined if nobody was in play.
    """
    return _ratio(total("violations", violations), total("in_play_steps", in_play_steps))


def detection_rate(detections: Tensor, violations: Tensor) -> Tensor:
    """sum detections / sum violations: principle 4, monitoring; near p of `Monitoring`.

    Undefined without a violation.
    """
    return _ratio(total("detections", detections), total("violations", violations))


def recidivism(returns_to_violation: Tensor, violations: Tensor) -> Tensor:
    """sum returns_to_violation / sum violations, 0..1: principle 5, graduated sanctions.

    The share of turns with a violation by agents who were sanctioned before in the same episode. Undefined
    without a violation.
    """
    return _ratio(total("returns_to_violation", returns_to_violation), total("violations", violations))


def sanctions_per_violation(sanctions: Tensor, violations: Tensor) -> Tensor:
    """sum sanctions / sum violations: principle 5, graduated sanctions.

    Above 1 where tags are sanctioned too. Undefined without a violation.
    """
    return _ratio(total("sanctions", sanctions), total("violations", violations))


_RATIOS: Final = {
    "own_share_of_bites": own_share_of_bites,
    "detection_rate": detection_rate,
    "recidivism": recidivism,
    "sanctions_per_violation": sanctions_per_violation,
}


def unjust_share_of_tags(unjust_tags: Tensor, tags: Tensor) -> Tensor:
    """sum unjust_tags / sum tags, 0..1: principle 6, conflict resolution; undefined without a tag."""
    return _ratio(total("unjust_tags", unjust_tags), total("tags", tags))


def net_income(harvest: Tensor, fines: Tensor, transfers: Tensor) -> Tensor:
    """harvest - fines + transfers of each agent, float64 [..., N]; below 0 where fines exceed all else.

    Payments are float32: what they leave by rounding alone, a millionth of all three, is 0.
    """
    got, gave = _checked("harvest", harvest), _checked("fines", fines)
    more = _checked("transfers", transfers)
    if not got.shape == gave.shape == more.shape:
        shapes = [list(own.shape) for own in (got, gave, more)]
        raise ValueError(f"harvest, fines and transfers are {shapes}; allowed: equal shapes")
    income = got - gave + more
    return torch.where(income.abs() <= _ROUNDING * (got + gave + more), 0.0, income)


def equality(income: Tensor) -> Tensor:
    """1 - Gini of incomes [..., N], see `cprl.measuring.social.equality`, e.g. of `net_income`.

    From 1/N (one agent has everything) to 1 (all have the same). Undefined where nobody has anything, and
    where somebody has less than nothing, since the Gini coefficient then has no bounds.
    """
    income = _checked("income", income, lowest=-torch.inf)
    value = social.equality(income.clamp(min=0.0).unsqueeze(-2))
    return torch.where((income < 0).any(-1), torch.nan, value)


def equality_within(income: Tensor, groups: Groups) -> Tensor:
    """`equality` within each of G groups, float64 [..., G]: principle 8, nested enterprises."""
    income = _checked("income", income, lowest=-torch.inf)
    return torch.stack([equality(income[..., own]) for own in check_groups(groups, income.shape[-1])], -1)


def equality_between(income: Tensor, groups: Groups) -> Tensor:
    """`equality` of the groups' mean incomes, each group counted once: principle 8, nested enterprises."""
    income = _checked("income", income, lowest=-torch.inf)
    own = check_groups(groups, income.shape[-1])
    return equality(torch.stack([income[..., agents].mean(-1) for agents in own], -1))


def harvest_over_yield(harvest: Tensor, steps: Tensor, sustainable_yield: float) -> Tensor:
    """sum R_i / (sustainable_yield x T), a ratio: principle 2, fit to local conditions.

    Above 1 where more was taken than grows back forever, or where the yield is a lower bound. Undefined where
    that is 0. `cprl.measuring.social.yield_share` adds the first stock.

    Args:
        harvest: apples of each agent.
        steps: steps of the episode, [...].
        sustainable_yield: apples per step that can be harvested forever, at least 0.
    """
    allowed = "a finite number >= 0"
    if isinstance(sustainable_yield, bool) or not isinstance(sustainable_yield, int | float):
        raise refusal("sustainable_yield", sustainable_yield, allowed)
    if not 0 <= sustainable_yield < torch.inf:
        raise refusal("sustainable_yield", sustainable_yield, allowed)
    taken = total("harvest", harvest)
    played = _checked("steps", steps, axes=0)
    if played.shape != taken.shape:
        raise ValueError(f"steps is {list(played.shape)}; allowed: {list(taken.shape)}, as harvest without N")
    return _ratio(taken, sustainable_yield * played)


def _ratio(part: Tensor, whole: Tensor) -> Tensor:
    if part.shape != whole.shape:
        shapes = f"{list(part.shape)} and {list(whole.shape)}"
        raise ValueError(f"the batch axes are {shapes}; allowed: equal shapes")
    return torch.where(whole > 0, part / whole, torch.nan)


def _checked(name: str, values: Tensor, *, lowest: float = 0.0, axes: int = 1) -> Tensor:
    """The values in float64: float32 would round a long episode's."""
    if not isinstance(values, Tensor) or values.dtype == torch.bool or values.is_complex():
        kind = values.dtype if isinstance(values, Tensor) else f"a {type(values).__name__}"
        raise ValueError(f"{name} is {kind}; allowed: a torch tensor of numbers")
    if values.ndim < axes or (axes and values.shape[-1] == 0):
        raise ValueError(f"{name} is {list(values.shape)}; allowed: [..., N] with at least one agent")
    if not ((values >= lowest) & (values < torch.inf)).all() or bool((values == -torch.inf).any()):
        below, least = ("", "") if lowest < 0 else ("a number below 0, ", ", at least 0")
        raise ValueError(f"{name} holds {below}NaN or infinity; allowed: finite numbers{least}")
    return values.to(torch.float64)


def check_groups(groups: Groups, agents: int) -> list[list[int]]:
    """The groups as lists.

    Raises:
        ValueError: unless each agent, 0 to agents - 1, belongs to one group, and no group is empty.
    """
    allowed = f"the agents of each group, each of 0 to {agents - 1} once"
    found = [
        [integer("an agent of groups", agent, 0, agents - 1) for agent in listed("groups", own, allowed)]
        for own in listed("groups", groups, allowed)
    ]
    if sorted(agent for own in found for agent in own) != list(range(agents)) or not all(found):
        raise refusal("groups", groups, allowed)
    return found
