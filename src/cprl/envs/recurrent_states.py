"""The states of recurrent networks where an episode begins: what environments and collectors do for them."""

import torch
from tensordict import TensorDictBase
from torch import Tensor

from cprl import keys

_NAME = keys.RECURRENT_STATE[1]


def begin_states(
    carried: TensorDictBase, before: TensorDictBase, began: TensorDictBase | Tensor | None
) -> None:
    """Carries ("agents", "recurrent_state") on, with zeros where an episode begins; nothing where there is
    none.

    Args:
        carried: the input of the next turn, which gets it.
        before: a TensorDict that may have it, [B, N, M].
        began: the worlds whose episode begins, bool [B, 1], or a turn with which their last one has ended;
            None for all.
    """
    agents = before.get(keys.AGENTS, None)
    states = agents.get(_NAME, None) if isinstance(agents, TensorDictBase) else None
    if states is None:
        return
    if isinstance(began, TensorDictBase):
        began = began["next"][keys.DONE]
    none = torch.zeros_like(states)
    carried_on = none if began is None else torch.where(began.reshape(-1, 1, 1), none, states)
    keys.put(keys.entry(carried, keys.AGENTS), _NAME, carried_on)
