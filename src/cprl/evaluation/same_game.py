"""Checks that runs have the same game, and names the differences."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any, Final

import torch

from cprl.commons.game import Game
from cprl.stored import LoadedRun

_LONGEST: Final = 40
"""The largest number of characters of a value in a message."""


def check_same_game(runs: Mapping[str, LoadedRun]) -> None:
    """Checks that all runs, by name, have the game of the first.

    Raises:
        ValueError: names the differences.
    """
    first, *others = runs
    for other in others:
        found = differences(runs[first].game, runs[other].game)
        found += transform_differences(runs[first], runs[other])
        if found:
            raise ValueError(
                f"{first} and {other} have different games: {'; '.join(found)}; allowed: runs of the same "
                "game"
            )


def differences(game: Any, other: Any) -> list[str]:
    """The fields in which games differ, of a commons those of map, rules and observation, with their values
    if they are short, and the institutions."""
    if not (isinstance(game, Game) and isinstance(other, Game)):
        if game == other:
            return []
        alike = is_dataclass(game) and type(game) is type(other)
        return (_field_differences(game, other) if alike else []) or [f"{game!r} and {other!r}"]
    pairs = (game.map, other.map), (game.rules, other.rules), (game.observation, other.observation)
    found = [line for mine, theirs in pairs for line in _field_differences(mine, theirs)]
    if game.institutions != other.institutions:
        names = (", ".join(type(own).__name__ for own in of.institutions) or "none" for of in (game, other))
        found.append(f"institutions {' and '.join(names)}, or their values")
    return found


def _field_differences(mine: Any, theirs: Any) -> list[str]:
    found = []
    for field in fields(mine):
        one, two = getattr(mine, field.name), getattr(theirs, field.name)
        if one != two:
            values = f"{one!r} and {two!r}"
            short = len(values) <= 2 * _LONGEST
            found.append(f"{type(mine).__name__}.{field.name} {values if short else 'differ'}")
    return found


def transform_differences(run: LoadedRun, other: LoadedRun) -> list[str]:
    """The differences between the transforms of two runs: their specification and their learned state."""
    if run.experiment.transforms != other.experiment.transforms:
        return [f"transforms {run.experiment.transforms} and {other.experiment.transforms}"]
    mine, theirs = run.transforms_state, other.transforms_state
    unlike = [
        name for name in mine if not torch.equal(torch.as_tensor(mine[name]), torch.as_tensor(theirs[name]))
    ]
    return [f"the learned state of the transforms differs: {', '.join(unlike)}"] if unlike else []
