"""The formulas of the metrics of whole episodes, on numpy arrays, and the social metrics of given turns.

All take totals of episodes, [..., N] for N agents with any leading batch axes, and return float64 [...], NaN
where a metric is undefined. Which metric is made of which totals, its unit and its source stand in
`cprl.measuring.registry`. None is computed from a shaped reward.

Below, R_i is the sum of agent i's harvest over its episode, T the number of steps, counted from 1.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cprl.institutions.equality import equality as equality, share_of as share_of
from cprl.values.array_types import Float64

AgentGroups = Sequence[Sequence[int]]
"""The indices of the agents of each group of nested enterprises; each agent belongs to one group."""

ROUNDING = 1e-6
"""The share of a number that payments round off, since they are float32."""


def lorenz_curve(harvest: Float64) -> Float64:
    """Return the share of the harvest that the k agents with the least have together, for k = 0 to N.

    Twice the area between the curve and the diagonal is the Gini coefficient, which is 1 - equality.

    Args:
        harvest: float [N], the apples of each agent.

    Returns:
        float [N + 1], from 0 to 1; NaN if there is no harvest.
    """
    total = harvest.sum()
    if total <= 0:
        return np.full(len(harvest) + 1, np.nan)
    return np.concatenate([[0.0], np.sort(harvest).cumsum() / total])


def gini(curve: Float64) -> float:
    """Return the Gini coefficient of a Lorenz curve [N + 1], 0 for equal shares."""
    return float(1 - (curve[1:] + curve[:-1]).sum() / (len(curve) - 1))


def incomes_of(harvest: Any, fines: Any, transfers: Any) -> Float64:
    """Return harvest - fines + transfers of each agent, float64 [..., N]; below 0 where fines exceed all
    else.

    Payments are float32, so an income within their rounding, a millionth of all three, is 0.
    """
    harvest, fines, transfers = (np.asarray(part, np.float64) for part in (harvest, fines, transfers))
    incomes = harvest - fines + transfers
    is_rounding = np.abs(incomes) <= ROUNDING * (harvest + fines + transfers)
    return np.where(is_rounding, 0.0, incomes)


def equality_within(incomes: Any, groups: AgentGroups) -> Float64:
    """Return the mean `equality` within groups, over the groups in which it is defined, [...].

    Principle 8 of Ostrom, "Governing the Commons" (1990): nested enterprises.
    """
    incomes = np.asarray(incomes, np.float64)
    return mean_of_defined(np.stack([equality(incomes[..., list(group)]) for group in groups], -1))


def equality_between(incomes: Any, groups: AgentGroups) -> Float64:
    """Return the `equality` of the groups' mean incomes, each group counted once, [...]; principle 8."""
    incomes = np.asarray(incomes, np.float64)
    return equality(np.stack([incomes[..., list(group)].mean(-1) for group in groups], -1))


def are_equal(values: Any, others: Any) -> bool:
    """Return whether numbers are equal up to the `ROUNDING` of payments; undefined ones equal each other."""
    return np.allclose(values, others, rtol=ROUNDING, atol=ROUNDING, equal_nan=True)


def mean_of_defined(values: Float64) -> Float64:
    """Return the mean over the last axis of the values that are defined; undefined where none is."""
    is_defined = ~np.isnan(values)
    return share_of(np.where(is_defined, values, 0.0).sum(-1), is_defined.sum(-1))


def summary(harvest: Tensor, in_play: Tensor) -> dict[str, Tensor]:
    """Return the social metrics of the T steps of episodes by name, each float64 [...], on the CPU.

    Args:
        harvest: apples harvested, float [..., T, N], at least 0.
        in_play: whether the action of this step had an effect, bool [..., T, N].

    Raises:
        ValueError: if a harvest is below 0, NaN or infinite.
    """
    from cprl.measuring.registry import compute_metrics  # imported here, because it imports these formulas

    if not ((harvest >= 0) & (harvest < torch.inf)).all():
        raise ValueError("harvest holds a number below 0, NaN or infinity; allowed: apples bitten")
    apples = harvest.numpy(force=True).astype(np.float64)
    has_harvested = apples > 0
    times = np.arange(1, apples.shape[-2] + 1)
    metrics = compute_metrics(
        {
            "steps": np.full(apples.shape[:-2], float(len(times))),
            "harvest": apples.sum(-2),
            "harvest_steps": has_harvested.sum(-2),
            "harvest_time": (has_harvested * times[:, None]).sum(-2),
            "in_play_steps": in_play.numpy(force=True).sum(-2),
        }
    )
    return {name: torch.from_numpy(np.asarray(values)) for name, values in metrics.items()}
