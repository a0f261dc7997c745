"""What environments share in a step: what a policy wrote, and what goes on from turn to turn."""

from typing import Final

import torch
from tensordict import TensorDictBase
from torch import Tensor

from cprl import keys
from cprl.system.compat import put_all

_WHOLE_NUMBERS: Final = (torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8)
"""The dtypes of actions that convert to int64 without a change of any number."""
_STATE: Final = keys.RECURRENT_STATE[1]


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
        began: the worlds whose episode begins, bool [B, 1], in which recurrent states do; None for none.
    """
    put_all(carried, {name: value for name, value in turn.items() if name not in replaced})
    of_agents = keys.entry(turn, keys.AGENTS).items()
    others = {name: value for name, value in of_agents if name not in replaced}
    put_all(keys.entry(carried, keys.AGENTS), others)
    if began is not None and _STATE in others:
        begin_states(carried, turn, began)


def begin_states(
    carried: TensorDictBase, before: TensorDictBase, began: TensorDictBase | Tensor | None
) -> None:
    """Carry ("agents", "recurrent_state") on, with zeros where an episode begins; nothing where there is
    none.

    Args:
        carried: the input of the next turn, which gets it.
        before: a TensorDict that may have it, [B, N, M].
        began: the worlds whose episode begins, bool [B, 1], or a turn with which their last one has ended;
            None for all.
    """
    agents = before.get(keys.AGENTS, None)
    states = agents.get(_STATE, None) if isinstance(agents, TensorDictBase) else None
    if states is None:
        return
    if isinstance(began, TensorDictBase):
        began = began["next"][keys.DONE]
    none = torch.zeros_like(states)
    going_on = none if began is None else torch.where(began.reshape(-1, 1, 1), none, states)
    keys.put(keys.entry(carried, keys.AGENTS), _STATE, going_on)
