"""What environments share in a step: what a policy wrote, and what goes on from turn to turn."""

from typing import Final

import torch
from tensordict import TensorDictBase
from torch import Tensor

from cprl import keys, recurrent_state
from cprl.system.compat import put_all

_WHOLE_NUMBERS: Final = (torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8)
"""The dtypes of actions that convert to int64 without a change of any number."""


def chosen(tensordict: TensorDictBase, name: str, size: torch.Size, device: torch.device) -> Tensor:
    """Return ("agents", "action") or ("agents", "decision") as int64 [B, N] on a device.

    Raises:
        ValueError: if it is missing, or has another shape or dtype; other integers are converted.
    """
    try:
        entry: Tensor = keys.entry(keys.entry(tensordict, keys.AGENTS), name)
    except (KeyError, AttributeError):
        raise ValueError(f'("agents", "{name}") is missing; allowed: int64 {list(size)}') from None
    if entry.dtype not in _WHOLE_NUMBERS or entry.shape != size:
        raise ValueError(
            f'("agents", "{name}") is {entry.dtype} {list(entry.shape)}; allowed: int64 {list(size)}'
        )
    if entry.dtype is not torch.int64:
        entry = entry.long()
    return entry if entry.device == device else entry.to(device)


def carry_on(
    carried: TensorDictBase, turn: TensorDictBase, began: Tensor | None, replaced: frozenset[str]
) -> None:
    """Put into the input of the next turn what others than the environment wrote into this one.

    Args:
        replaced: the entries that the environment writes anew itself, at the root and under "agents".
        began: the worlds whose episode begins, bool [B, 1], where recurrent states are zero; None for none.
    """
    put_all(carried, {name: value for name, value in turn.items() if name not in replaced})
    of_agents = keys.entry(turn, keys.AGENTS).items()
    others = {name: value for name, value in of_agents if name not in replaced}
    put_all(keys.entry(carried, keys.AGENTS), others)
    if began is not None and recurrent_state.AFTER in others:
        recurrent_state.carry(carried, turn, began)
