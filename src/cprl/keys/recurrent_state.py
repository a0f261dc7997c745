"""Pass the states of recurrent networks from one turn to the next.

In each turn a policy calls `prepare` and `write_states`, an environment calls `carry` to hand the states to
its next turn, and learners call `read_states`. Two entries of "agents" hold the states, see `cprl.keys`: the
states before a turn, and the states after the turn's observation. Both are [B, N, M], with M numbers for
each agent; an agent whose state has only H numbers uses the first H of them.
"""

from typing import Any, Final

import torch
from tensordict import TensorDictBase
from torch import Tensor

from cprl import keys

BEFORE: Final = keys.RECURRENT_STATE_BEFORE[-1]
"""The name of the entry with the states that policies read in a turn."""
AFTER: Final = keys.RECURRENT_STATE[-1]
"""The name of the entry with the states that policies write in a turn."""


def prepare(agents: TensorDictBase, size: tuple[int, ...], device: torch.device) -> None:
    """Make both entries of a turn: the states before it, zero if there are none yet, and zeros for those
    after it, into which policies write.

    Args:
        agents: the entries of "agents" of the turn, which get both.
        size: [B, N, M].

    Raises:
        ValueError: if there are states of another size.
    """
    states_before = agents.get(AFTER, None)
    if states_before is None:
        states_before = torch.zeros(size, device=device)
    elif tuple(states_before.shape) != size:
        raise ValueError(
            f'("agents", "{AFTER}") is {list(states_before.shape)}; allowed: {list(size)}, from the same '
            "policies in the turn before, or none"
        )
    keys.put(agents, BEFORE, states_before)
    keys.put(agents, AFTER, torch.zeros_like(states_before))


def write_states(agents: TensorDictBase, index: tuple[Any, ...], states: Tensor) -> None:
    """Write the states of some agents after this turn, float32 [.., H].

    Args:
        agents: the entries of "agents" of the turn.
        index: selects the agents, as in `read_states`.
    """
    keys.entry(agents, AFTER)[(*index, ..., slice(states.shape[-1]))] = states


def read_states(agents: Any, index: tuple[Any, ...], cells: int, name: str = BEFORE) -> Any:
    """Return the states of some agents in a turn, float32 [.., H].

    Args:
        agents: the entries of "agents" by name, [B, N, M]: a TensorDict, or arrays.
        index: selects the agents, e.g. `(slice(None), [0, 2])`; `()` selects all.
        cells: the numbers H in the state of one agent.
        name: `BEFORE` for the states before the turn, `AFTER` for those after it.
    """
    return agents[name][(*index, ..., slice(cells))]


def carry(next_input: TensorDictBase, turn: TensorDictBase, began: Tensor | None) -> None:
    """Put the states after a turn into the input of the next one, zero where an episode begins.

    Do nothing if the turn has no states.

    Args:
        next_input: the input of the next turn; it may be the same TensorDict as `turn`.
        turn: the turn that was just played.
        began: marks the worlds whose episode begins, bool [B, 1]; None if it begins in all.
    """
    agents = turn.get(keys.AGENTS, None)
    states = None if agents is None else agents.get(AFTER, None)
    if states is None:
        return
    zeros = torch.zeros_like(states)
    carried_states = zeros if began is None else torch.where(began.reshape(-1, 1, 1), zeros, states)
    keys.put(keys.entry(next_input, keys.AGENTS), AFTER, carried_states)
