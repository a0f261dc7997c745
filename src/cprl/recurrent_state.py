"""The states of recurrent networks from turn to turn.

Policies `prepare` and `write` them, environments `carry` them into the next turn, learners `read` them. They
are two entries of "agents", see `cprl.keys`: the states before a turn and those after its observation. An
agent whose state has H numbers has them in the first H of the M of an entry.
"""

from typing import Any, Final

import torch
from tensordict import TensorDictBase
from torch import Tensor

from cprl import keys

BEFORE: Final = keys.RECURRENT_STATE_BEFORE[-1]
"""The name of the states that policies read in a turn."""
AFTER: Final = keys.RECURRENT_STATE[-1]
"""The name of those that they write in it."""


def prepare(agents: TensorDictBase, size: tuple[int, ...], device: torch.device) -> None:
    """Note the states that policies read in this turn, zero where there are none, and make room for those
    that they write.

    Args:
        agents: the entries of "agents" of the turn; gets both.
        size: [B, N, M].

    Raises:
        ValueError: if there are states of another size.
    """
    before = agents.get(AFTER, None)
    if before is None:
        before = torch.zeros(size, device=device)
    elif tuple(before.shape) != size:
        raise ValueError(
            f'("agents", "{AFTER}") is {list(before.shape)}; allowed: {list(size)}, from the same policies '
            "in the turn before, or none"
        )
    keys.put(agents, BEFORE, before)
    keys.put(agents, AFTER, torch.zeros_like(before))


def write(agents: TensorDictBase, at: tuple[Any, ...], states: Tensor) -> None:
    """Write the states of some agents after this turn, [.., H]; `at` is their index, as of `read`."""
    keys.entry(agents, AFTER)[(*at, ..., slice(states.shape[-1]))] = states


def read(agents: Any, at: tuple[Any, ...], cells: int, name: str = BEFORE) -> Any:
    """Return the states of some agents in a turn, float32 [.., H], those before it or by their other name
    those after it.

    Args:
        agents: the entries of "agents" by name, [B, N, M]: a TensorDict, or arrays.
        at: the index of the agents, e.g. `(slice(None), [0, 2])`; `()` for all.
        cells: the numbers H of one state.
    """
    return agents[name][(*at, ..., slice(cells))]


def carry(carried: TensorDictBase, turn: TensorDictBase, began: Tensor | None) -> None:
    """Put the states after a turn into the input of the next one, zero where an episode begins; do nothing
    where there are none.

    Args:
        carried: the input of the next turn.
        turn: the one before it; also the same TensorDict, where it has the states already.
        began: the worlds whose episode begins, bool [B, 1]; None for all.
    """
    agents = turn.get(keys.AGENTS, None)
    states = None if agents is None else agents.get(AFTER, None)
    if states is None:
        return
    zeros = torch.zeros_like(states)
    kept = zeros if began is None else torch.where(began.reshape(-1, 1, 1), zeros, states)
    keys.put(keys.entry(carried, keys.AGENTS), AFTER, kept)
