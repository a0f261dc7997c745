"""The state of B worlds as plain arrays, and the check that it has the form of a game's."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cprl.commons import world
from cprl.commons.game import Game
from cprl.commons.rules import GROUPS
from cprl.commons.world import empty_worlds
from cprl.institutions import ledger
from cprl.institutions.arrays import lasting
from cprl.institutions.law import MODULES, check_names, new_law
from cprl.values import shown

State = dict[str, NDArray[Any]]

check_names((world, *GROUPS.values(), ledger, *MODULES.values()))


def numbers(game: Game) -> dict[str, int]:
    """Return the numbers of a game that `Kept.high` names."""
    rules = game.rules
    return {
        "last_row": game.map.height - 1,
        "last_col": game.map.width - 1,
        "episode_steps": rules.episode_steps,
        "cooldown_steps": rules.cooldown_steps,
        "signals": rules.signals,
        "most_hits": rules.hits_to_tag - 1,
    }


def checked(state: Mapping[str, Any], *, worlds: int, game: Game) -> State:
    """Return a state as arrays, after checking names, shapes, dtypes and ranges of its entries.

    Whether a game comes into it is not checked, e.g. that no agent is in a wall.
    """
    expected = {name: (array, how) for name, array, how in lasting(empty_worlds(game, worlds))}
    if game.institutions:
        expected |= {name: (array, how) for name, array, how in lasting(new_law(game, worlds))}
    if set(state) != set(expected):
        missing = sorted(set(expected) - set(state))
        unknown = sorted(map(str, set(state) - set(expected)))
        raise ValueError(
            f"the state lacks {missing} and has the unknown entries {shown(unknown)}; allowed: exactly "
            f"{sorted(expected)}"
        )
    arrays = {name: _as_array(name, state[name]) for name in expected}
    highest = numbers(game)
    for name, (form, how) in expected.items():
        array = arrays[name]
        if array.shape != form.shape or array.dtype != form.dtype:
            raise ValueError(
                f"state[{name!r}] is {array.dtype} {list(array.shape)}; allowed: {form.dtype} "
                f"{list(form.shape)}"
            )
        high = highest[how.high] if isinstance(how.high, str) else how.high
        _check_range(name, array, how.low, high)
    return arrays


def _as_array(name: str, values: Any) -> NDArray[Any]:
    """Return an entry as an array, e.g. of a list or a torch tensor."""
    try:
        return np.asarray(values)
    except (ValueError, TypeError) as error:  # nested lists of unequal lengths, or memory of a GPU
        raise ValueError(f"state[{name!r}] is {shown(values)}; allowed: an array on the CPU") from error


def _check_range(name: str, array: NDArray[Any], low: int, high: int) -> None:
    """Refuse an entry out of range; numbers with a fraction have no upper bound."""
    if array.dtype == np.bool_:
        return
    if array.dtype == np.float64:
        wrong, allowed = ~(np.isfinite(array) & (array >= 0)), "a number of at least 0"
    else:
        wrong, allowed = (array < low) | (array > high), f"{low} to {high}"
    if wrong.any():
        index = tuple(int(entry) for entry in np.argwhere(wrong)[0])
        raise ValueError(f"state[{name!r}]{list(index)} is {array[index]}; allowed: {allowed}")
