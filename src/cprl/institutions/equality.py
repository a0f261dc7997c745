"""Equality: how evenly agents share what they have; governors see it, `cprl.measuring` reports it."""

from typing import Any

import numpy as np

from cprl.values.array_types import Float64


def share_of(part: Any, whole: Any) -> Float64:
    """Return part / whole, undefined if the whole is 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(np.greater(whole, 0), np.divide(part, whole), np.nan)


def equality(incomes: Any) -> Float64:
    """Return 1 - Gini of the incomes of N agents, [..., N]: 1 - sum_ij |x_i - x_j| / (2 N sum_i x_i).

    It ranges from 1/N, if one agent has everything, to 1, if all have the same. It is undefined if nobody has
    anything, or somebody has less than nothing, since Gini then has no bounds.
    """
    incomes = np.asarray(incomes, np.float64)
    held = incomes.clip(min=0.0)
    gaps = np.abs(held[..., :, None] - held[..., None, :]).sum((-2, -1))
    value = 1 - share_of(gaps, 2 * held.shape[-1] * held.sum(-1))
    return np.where((incomes < 0).any(-1), np.nan, value)
