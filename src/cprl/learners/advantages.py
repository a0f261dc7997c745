"""Advantages of whole rollouts, by TorchRL's GAE."""

from collections.abc import Mapping
from typing import Final

from torch import Tensor
from torchrl.objectives.value.functional import generalized_advantage_estimate

from cprl.learners.settings import RolloutSettings

_SMALL: Final = 1e-8


def advantages(
    columns: Mapping[str, Tensor], value: Tensor, next_value: Tensor, *, settings: RolloutSettings
) -> tuple[Tensor, Tensor]:
    """The advantage of each step, and the target of its value.

    Args:
        columns: "reward", "done" and "terminated", of lanes [L, T], or of members of teams [L, T, S].
        value: of the states before each step, [L, T, ..., 1].
        next_value: of the states after it.
        settings: the discount, lambda, and whether advantages are normalised within each lane.

    Returns:
        Both of the shape of `value`.
    """
    advantage, target = generalized_advantage_estimate(
        settings.gamma,
        settings.gae_lambda,
        value,
        next_value,
        *(_like(columns[name], value) for name in ("reward", "done", "terminated")),
        time_dim=1,
    )
    if settings.normalize_advantage:
        of_lane = tuple(range(1, advantage.ndim))
        spread = advantage.std(of_lane, keepdim=True)
        advantage = (advantage - advantage.mean(of_lane, keepdim=True)) / (spread + _SMALL)
    return advantage, target


def _like(column: Tensor, value: Tensor) -> Tensor:
    """A field of lanes [L, T], or of team members [L, T, S], expanded to the shape of values, whose last axis
    has size 1."""
    one_each = [1] * (value.ndim - column.ndim)
    return column.reshape(*column.shape, *one_each).expand_as(value)
