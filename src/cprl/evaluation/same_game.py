"""Whether runs play the same game, and what differs where they do not."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Final

from cprl.commons.game import Game
from cprl.stored import LoadedRun

_LONGEST: Final = 40
"""Characters of a value that a message still tells."""


def check_same_game(runs: Mapping[str, LoadedRun]) -> None:
    """That all runs, by name, play the game of the first.

    Raises:
        ValueError: says what differs.
    """
    first, *others = runs
    for other in others:
        found = differences(runs[first].game, runs[other].game)
        if found:
            raise ValueError(
                f"{first} and {other} are runs of unlike games: {'; '.join(found)}; "
                "agents can visit each other in the same game alone"
            )


def differences(game: Game, other: Game) -> list[str]:
    """The fields of map, rules and observation in which games differ, with their values where short."""
    found = []
    for mine, theirs in (
        (game.map, other.map),
        (game.rules, other.rules),
        (game.observation, other.observation),
    ):
        for field in fields(mine):
            one, two = getattr(mine, field.name), getattr(theirs, field.name)
            if one != two:
                told = f"{one!r} beside {two!r}"
                short = len(told) <= 2 * _LONGEST
                found.append(f"{type(mine).__name__}.{field.name} {told if short else 'differ'}")
    return found
