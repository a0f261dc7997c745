"""Helpers of a step that environments share: read actions, and carry entries over to the next turn."""

from typing import Final

import torch
from tensordict import TensorDictBase
from torch import Tensor

from cprl import keys
from cprl.keys import recurrent_state
from cprl.system.compat.tensordicts import put_all

_INTEGER_DTYPES: Final = (torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8)
"""The dtypes that actions may have: they convert to int64 without a change of any number."""


def read_choices(tensordict: TensorDictBase, name: str, size: torch.Size, device: torch.device) -> Tensor:
    """Return the actions or decisions that a policy wrote, as int64 [B, N] on a device.

    Args:
        name: "action" or "decision", the entry under "agents".
        size: the shape [B, N].

    Raises:
        ValueError: if the entry is missing, has another shape, or holds no integers.
    """
    try:
        entry: Tensor = keys.entry(keys.entry(tensordict, keys.AGENTS), name)
    except (KeyError, AttributeError):
        raise ValueError(f'("agents", "{name}") is missing; allowed: int64 {list(size)}') from None
    if entry.dtype not in _INTEGER_DTYPES or entry.shape != size:
        raise ValueError(
            f'("agents", "{name}") is {entry.dtype} {list(entry.shape)}; allowed: int64 {list(size)}'
        )
    if entry.dtype is not torch.int64:
        entry = entry.long()
    return entry if entry.device == device else entry.to(device)


def carry_on(
    next_input: TensorDictBase, turn: TensorDictBase, is_first: Tensor | None, env_entries: frozenset[str]
) -> None:
    """Copy the entries of a turn that policies and transforms wrote into the input of the next turn.

    Args:
        is_first: bool [B, 1], True for worlds whose next turn is the first of an episode: there recurrent
            states become zero. None where no episode begins.
        env_entries: the entries that the environment itself writes in every turn, at the root and under
            "agents"; they are not copied.
    """
    put_all(next_input, {name: value for name, value in turn.items() if name not in env_entries})
    agents = keys.entry(turn, keys.AGENTS).items()
    agent_entries = {name: value for name, value in agents if name not in env_entries}
    put_all(keys.entry(next_input, keys.AGENTS), agent_entries)
    if is_first is not None and recurrent_state.AFTER in agent_entries:
        recurrent_state.carry(next_input, turn, is_first)
