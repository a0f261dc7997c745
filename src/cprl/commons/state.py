"""The state of B worlds as plain arrays by name, and the check that a state fits a game."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cprl.commons.game import Game
from cprl.commons.world import empty_worlds
from cprl.institutions.arrays import state_arrays
from cprl.institutions.law import new_law
from cprl.values import short_repr

State = dict[str, NDArray[Any]]
"""The arrays of a state, [B, ...], by their names in `Worlds` and `Law`."""


def largest_entries(game: Game) -> dict[str, int]:
    """Return the largest entries of arrays that depend on the game, by the names that `InState.high` uses."""
    rules = game.rules
    return {
        "last_row": game.map.height - 1,
        "last_col": game.map.width - 1,
        "episode_steps": rules.episode_steps,
        "cooldown_steps": rules.cooldown_steps,
        "signals": rules.signals,
        "most_hits": rules.hits_to_tag - 1,
    }


def check_state(state: Mapping[str, Any], *, worlds: int, game: Game) -> State:
    """Return a state as arrays, after checking the names, shapes, dtypes and ranges of its entries.

    It is not checked whether a game can reach the state: an agent may be inside a wall.

    Raises:
        ValueError: for a state that does not fit this number of worlds of the game.
    """
    expected = {name: entry for name, *entry in state_arrays(empty_worlds(game, worlds))}
    if game.institutions:
        expected |= {name: entry for name, *entry in state_arrays(new_law(game, worlds))}
    if set(state) != set(expected):
        missing = sorted(set(expected) - set(state))
        unknown = sorted(map(str, set(state) - set(expected)))
        raise ValueError(
            f"the state lacks {missing} and has the unknown entries {short_repr(unknown)}; allowed: exactly "
            f"{sorted(expected)}"
        )
    arrays = {name: _as_array(name, state[name]) for name in expected}
    largest = largest_entries(game)
    for name, (example, entry_range) in expected.items():
        array = arrays[name]
        if array.shape != example.shape or array.dtype != example.dtype:
            raise ValueError(
                f"state[{name!r}] is {array.dtype} {list(array.shape)}; allowed: {example.dtype} "
                f"{list(example.shape)}"
            )
        high = largest[entry_range.high] if isinstance(entry_range.high, str) else entry_range.high
        _check_range(name, array, entry_range.low, high)
    return arrays


def _as_array(name: str, values: Any) -> NDArray[Any]:
    """Return an entry of a state, e.g. a list or a torch tensor, as a numpy array."""
    try:
        return np.asarray(values)
    except (ValueError, TypeError) as error:  # nested lists of unequal lengths, or memory of a GPU
        raise ValueError(f"state[{name!r}] is {short_repr(values)}; allowed: an array on the CPU") from error


def _check_range(name: str, array: NDArray[Any], low: int, high: int) -> None:
    """Raise a ValueError for an array with an entry out of range; float64 entries have no upper bound."""
    if array.dtype == np.bool_:
        return
    if array.dtype == np.float64:
        wrong = ~(np.isfinite(array) & (array >= 0))
        allowed = "a number of at least 0"
    else:
        wrong = (array < low) | (array > high)
        allowed = f"{low} to {high}"
    if wrong.any():
        index = tuple(int(entry) for entry in np.argwhere(wrong)[0])
        raise ValueError(f"state[{name!r}]{list(index)} is {array[index]}; allowed: {allowed}")
