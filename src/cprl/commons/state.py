"""The state of B worlds as plain arrays, and the check that a game can be in it."""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cprl.commons.game import Game
from cprl.commons.world import COL_STEP, PLAYING, ROW_STEP, TRUNCATED, Worlds, empty_worlds
from cprl.institutions.arrays import STATE, STEPS, lasting
from cprl.institutions.law import new_law
from cprl.values import shown

State = dict[str, NDArray[Any]]

DERIVED: Final = ("near", "stock_left", "waste_left")
"""Entries of `Worlds` that are computed from the others."""

OF_A_RULE: Final = {
    "moved_after_firing": "agent_1_right_moves_agent_0",
    "cooldown": "cooldown_steps",
    "signal": "signals",
    "cleans": "may_clean",
}
"""Entries of `Worlds` that only games with a rule have in their state, by the rule: so the states of others
are those that earlier versions kept."""

NAMES: Final = tuple(name for name in Worlds._fields if name not in (*DERIVED, *OF_A_RULE, "waste"))
"""Entries of every state; those of a game are `names`."""

_MAX_INT32: Final = 2**31 - 1


def names(game: Game) -> tuple[str, ...]:
    """Entries of a state without institutions; with the game they determine the future completely."""
    of_rules = tuple(name for name, rule in OF_A_RULE.items() if getattr(game.rules, rule))
    return NAMES + of_rules + (("waste",) if game.map.river else ())


def checked(state: Mapping[str, Any], *, worlds: int, game: Game) -> State:
    """Returns a state as arrays, after checking that the game can be in it."""
    empty = empty_worlds(game, worlds)
    expected = {name: getattr(empty, name) for name in names(game)}
    law = new_law(game, worlds) if game.institutions else None
    if law is not None:
        expected |= {name: array for name, array, _ in lasting(law, STATE, STEPS)}
    if set(state) != set(expected):
        missing = sorted(set(expected) - set(state))
        unknown = sorted(map(str, set(state) - set(expected)))
        raise ValueError(
            f"the state lacks {missing} and has the unknown entries {shown(unknown)}; allowed: exactly "
            f"{sorted(expected)}"
        )
    arrays = {name: _as_array(name, state[name]) for name in expected}
    for name, form in expected.items():
        array = arrays[name]
        if array.shape != form.shape or array.dtype != form.dtype:
            raise ValueError(
                f"state[{name!r}] is {array.dtype} {list(array.shape)}; allowed: {form.dtype} "
                f"{list(form.shape)}"
            )
    _check_ranges(arrays, game)
    _check_places(arrays, game)
    if law is not None:
        _check_law(arrays, game, law)
    return arrays


def _as_array(name: str, values: Any) -> NDArray[Any]:
    """An entry as an array, e.g. of a list or a torch tensor."""
    try:
        return np.asarray(values)
    except (ValueError, TypeError) as error:  # nested lists of unequal lengths, or memory of a GPU
        raise ValueError(f"state[{name!r}] is {shown(values)}; allowed: an array on the CPU") from error


def _check_ranges(arrays: State, game: Game) -> None:
    board, rules = game.map, game.rules
    ranges = {
        "number": (0, 2**32 - 1),
        "stock": (0, 1),
        "stock_before": (0, 1),
        "waste": (0, 1),
        "row": (0, board.height - 1),
        "col": (0, board.width - 1),
        "heading": (0, 3),
        "out_steps": (0, _MAX_INT32),
        "cooldown": (0, rules.cooldown_steps),
        "signal": (0, rules.signals),
        "hits": (0, rules.hits_to_tag - 1),
        "tagged_step": (0, rules.episode_steps),
        "offences": (0, _MAX_INT32),
        "harvested": (0, rules.episode_steps),
        "step": (0, rules.episode_steps),
        "episode": (-1, _MAX_INT32),
        "ended": (PLAYING, TRUNCATED),
    }
    for name, (low, high) in ranges.items():
        if name in arrays:
            _refuse(arrays, name, (arrays[name] < low) | (arrays[name] > high), f"{low} to {high}")
    out = arrays["out_steps"] > 0
    _refuse(arrays, "in_play", arrays["in_play"] & out, "False while out_steps is above 0")


def _check_law(arrays: State, game: Game, law: Any) -> None:
    """Checks what institutions remember."""
    for name, empty, lasts in lasting(law, STATE, STEPS):
        values = arrays[name]
        if empty.dtype == np.float64:
            wrong, allowed = ~(np.isfinite(values) & (values >= 0)), "a number of at least 0"
        else:
            high = game.rules.episode_steps if lasts == STEPS else _MAX_INT32
            wrong, allowed = (values < 0) | (values > high), f"0 to {high}"
        _refuse(arrays, name, wrong, allowed)
    for number, ballot in enumerate(game.ballots):
        wrong = np.zeros(arrays["in_force"].shape, np.bool_)
        wrong[:, number] = ~np.isin(arrays["in_force"][:, number], ballot.choices)
        _refuse(arrays, "in_force", wrong, f"one of {list(ballot.choices)}")


def _check_places(arrays: State, game: Game) -> None:
    """Checks that no agent is in a wall, and that agents in play share a cell only if the rules allow it.

    In worlds that have not begun, agents are nowhere yet.
    """
    row, col = arrays["row"], arrays["col"]
    walls = np.zeros((game.map.height, game.map.width), np.bool_)
    if game.map.walls:
        walls[tuple(np.array(game.map.walls).T)] = True
    _refuse(arrays, "row", walls[row, col] & (arrays["episode"] >= 0), "a cell without a wall")
    if game.rules.agent_1_right_moves_agent_0:
        _check_moved(arrays, walls)
    if game.rules.pairwise_clashes:
        return
    shares = (row[:, :, None] == row[:, None]) & (col[:, :, None] == col[:, None])
    shares &= arrays["in_play"][:, :, None] & arrays["in_play"][:, None]
    shares &= ~np.eye(game.agents, dtype=np.bool_)
    _refuse(arrays, "row", shares.any(2), "a cell without another agent in play")


def _check_moved(arrays: State, walls: NDArray[np.bool_]) -> None:
    """Checks that whoever was moved after it fired did fire, from the cell to its left, which is no wall."""
    moved, right = arrays["moved_after_firing"], (arrays["heading"] + 1) % 4
    row, col = arrays["row"] - np.array(ROW_STEP)[right], arrays["col"] - np.array(COL_STEP)[right]
    inside = np.pad(~walls, 1)[row + 1, col + 1]
    allowed = "False but where the agent fired, from an open cell to its left"
    _refuse(arrays, "moved_after_firing", moved & ~(arrays["fired"] & inside), allowed)


def _refuse(arrays: State, name: str, wrong: NDArray[np.bool_], allowed: str) -> None:
    if wrong.any():
        index = tuple(int(entry) for entry in np.argwhere(wrong)[0])
        column = f" (column {arrays['col'][index]})" if name == "row" else ""
        raise ValueError(f"state[{name!r}]{list(index)} is {arrays[name][index]}{column}; allowed: {allowed}")
