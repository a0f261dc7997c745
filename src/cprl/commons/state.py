"""The state of B worlds as plain arrays: read out, checked, put back."""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cprl.commons.game import Game
from cprl.commons.world import PLAYING, TRUNCATED, Worlds, empty_worlds

State = dict[str, NDArray[Any]]

DERIVED: Final = ("near", "stock_left")
"""Entries of `Worlds` that follow from the others."""

NAMES: Final = tuple(name for name in Worlds._fields if name not in DERIVED)
"""Entries of a state: it says all that the future depends on."""

_MOST: Final = 2**31 - 1


def checked(state: Mapping[str, Any], *, worlds: int, game: Game) -> State:
    """The state as arrays, if it is one that this game can be in.

    Args:
        state: arrays by `NAMES`, with the shapes and types of `Worlds`.
        worlds: how many worlds B.
        game: what is played.

    Raises:
        ValueError: names the entry, what came and what is allowed.
    """
    room = empty_worlds(worlds=worlds, agents=game.agents, sites=len(game.map.sites))
    wanted = {name: getattr(room, name) for name in NAMES}
    if set(state) != set(wanted):
        missing, unknown = sorted(set(wanted) - set(state)), sorted(set(state) - set(wanted))
        raise ValueError(f"the state lacks {missing} and has the unknown {unknown}; wanted: {sorted(wanted)}")
    arrays = {name: np.asarray(state[name]) for name in wanted}
    for name, array in arrays.items():
        if array.shape != wanted[name].shape or array.dtype != wanted[name].dtype:
            raise ValueError(
                f"state[{name!r}] is {array.dtype} {array.shape}; "
                f"wanted: {wanted[name].dtype} {wanted[name].shape}"
            )
    _check_ranges(arrays, game)
    _check_places(arrays, game)
    return arrays


def _check_ranges(arrays: State, game: Game) -> None:
    board, rules = game.map, game.rules
    ranges = {
        "number": (0, 2**32 - 1),
        "stock": (0, 1),
        "stock_before": (0, 1),
        "row": (0, board.height - 1),
        "col": (0, board.width - 1),
        "heading": (0, 3),
        "out_steps": (0, _MOST),
        "hits": (0, rules.hits_to_tag - 1),
        "tagged_step": (0, rules.episode_steps),
        "offences": (0, _MOST),
        "harvested": (0, rules.episode_steps),
        "step": (0, rules.episode_steps),
        "episode": (-1, _MOST),
        "ended": (PLAYING, TRUNCATED),
    }
    for name, (least, most) in ranges.items():
        _refuse(arrays, name, (arrays[name] < least) | (arrays[name] > most), f"{least} to {most}")
    out = arrays["out_steps"] > 0
    _refuse(arrays, "in_play", arrays["in_play"] & out, "False while there are turns to miss (out_steps)")


def _check_places(arrays: State, game: Game) -> None:
    """Nobody in a wall; no two in play on a cell, unless the rules allow it."""
    row, col = arrays["row"], arrays["col"]
    walls = np.zeros((game.map.height, game.map.width), np.bool_)
    if game.map.walls:
        walls[tuple(np.array(game.map.walls).T)] = True
    _refuse(arrays, "row", walls[row, col], "no cell of a wall")
    if game.rules.pairwise_clashes:
        return
    shares = (row[:, :, None] == row[:, None]) & (col[:, :, None] == col[:, None])
    shares &= arrays["in_play"][:, :, None] & arrays["in_play"][:, None]
    shares &= ~np.eye(game.agents, dtype=np.bool_)
    _refuse(arrays, "row", shares.any(2), "no cell with another agent in play")


def _refuse(arrays: State, name: str, wrong: NDArray[np.bool_], allowed: str) -> None:
    if wrong.any():
        at = tuple(int(index) for index in np.argwhere(wrong)[0])
        place = f" (column {arrays['col'][at]})" if name == "row" else ""
        raise ValueError(f"state[{name!r}]{list(at)} is {arrays[name][at]}{place}; allowed: {allowed}")
