"""What learners from rollouts keep of the latest steps, and how a step is written."""

from collections.abc import Mapping
from functools import cache
from math import prod
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from cprl.commons.spaces import Spaces
from cprl.learners.buffer.storage import torch_dtype
from cprl.learners.checks import check_rollouts
from cprl.learners.transitions import LaneTurn


class LaneShapes(Protocol):
    """The shapes of what each of L lanes sees, does and gets in a step."""

    @property
    def observation_shape(self) -> tuple[int, ...]:
        """Of an observation."""

    @property
    def action_shape(self) -> tuple[int, ...]:
        """Of an action."""

    @property
    def member_shape(self) -> tuple[int, ...]:
        """Of a reward."""

    def __len__(self) -> int: ...


def rollout_fields(
    spaces: Spaces, lanes: LaneShapes, size: tuple[int, ...], device: torch.device
) -> dict[str, Tensor]:
    """The fields of a `LaneTurn` for so many steps, zeros [*size, L, ...] each.

    Args:
        spaces: the dtype of observations.
        lanes: the shapes of the fields of one lane.
        size: the number of steps; with several rollouts, their number first.
        device: where.

    Raises:
        TooLargeError: if the device has less memory than they take.
    """
    shape, dtype = lanes.observation_shape, torch_dtype(spaces.observation_dtype)
    check_rollouts((prod(size), len(lanes)), shape, dtype, device)
    forms: dict[str, tuple[tuple[int, ...], torch.dtype]] = {
        "observation": (shape, dtype),
        "action": (lanes.action_shape, torch.int64),
        "next_observation": (shape, dtype),
        "reward": (lanes.member_shape, torch.float32),
        "done": ((), torch.bool),
        "terminated": ((), torch.bool),
    }
    return {
        name: torch.zeros((*size, len(lanes), *of_one), dtype=kind, device=device)
        for name, (of_one, kind) in forms.items()
    }


def refuse_full(stored: int, steps: int) -> None:
    """Raises a ValueError if all steps of a rollout are stored already."""
    if stored == steps:
        raise ValueError(f"the rollout already has {steps} steps; call update() before store()")


def write_turn(fields: Mapping[str, Tensor], at: tuple[int, ...], turn: LaneTurn, spaces: Spaces) -> None:
    """Writes a step of all lanes at a place of `rollout_fields`.

    Raises:
        ValueError: if the dtype of observations is not that of the spaces.
    """
    for seen in (turn.observation, turn.next_observation):
        if seen.dtype not in _dtypes(spaces.observation_dtype):
            raise ValueError(
                f"observations are {seen.dtype}; allowed: {spaces.observation_dtype}, from "
                "Spaces.observation_dtype: make the learner with the Spaces of the transformed "
                "environment"
            )
    for name, field in fields.items():
        field[at] = torch.as_tensor(getattr(turn, name))


@cache
def _dtypes(name: str) -> tuple[Any, Any]:
    """Of arrays and of tensors."""
    return np.dtype(name), torch_dtype(name)
