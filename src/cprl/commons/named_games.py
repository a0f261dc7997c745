"""Games by name: the published boards with their rules, and the games of the literature.

The published games are those of [W] M. Wiatrak, "Governing the Commons with Multi-Agent Reinforcement
Learning" (2019). All numbers come from its appendix A, and from the parameters and behaviour of its program.
The modules of the game are imported only when a game is made, so that command lines are checked quickly.
"""

from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, get_args

from cprl.commons.literature import LITERATURE_GAMES, game_of_literature
from cprl.values import checked, refusal

if TYPE_CHECKING:
    from cprl.commons.game import Game

Board = Literal["single_basic", "single_complex", "two_complex", "commons"]
"""The names of the published boards."""
Variant = Literal["published", "as_run"]
"""The variants of a published game: with the rules in the text of the study, or those of its program."""

BOARDS: Final[tuple[Board, ...]] = get_args(Board)
VARIANTS: Final[tuple[Variant, ...]] = get_args(Variant)
GAMES: Final[tuple[tuple[Board, Variant], ...]] = tuple(product(BOARDS, VARIANTS))
"""The published games: each board with each of its variants."""

BEAM_TO_EDGE_CELLS: Final = 7
"""A beam of this length crosses all rows of `two_complex`."""

_PROGRAM_RULES: Final[dict[str, Any]] = {"hits_to_tag": 2, "clashes": "pairwise", "growth": "before_bites"}
"""The rules of all games "as_run", which also have the group of rules `Quirks2019`."""
_COMMONS_RULES: Final[dict[str, Any]] = {"window_rows": 7, "window_columns": 15, "beam_length_cells": 6}
_BOARD_RULES: Final[dict[str, dict[Variant, dict[str, Any]]]] = {
    "single_basic": {
        "published": {"may_fire": False},
        "as_run": {"window_rows": 5, "may_fire": False},
    },
    "single_complex": {
        "published": {"may_fire": False},
        "as_run": {"window_rows": 5, "may_fire": False},
    },
    "two_complex": {
        "published": {},
        "as_run": {
            "window_rows": 5,
            # by heading: up, right, down, left
            "beam_length_cells": (BEAM_TO_EDGE_CELLS, 6, BEAM_TO_EDGE_CELLS, 7),
        },
    },
    "commons": {"published": _COMMONS_RULES, "as_run": _COMMONS_RULES},
}
"""The rules of each board by variant; those of the program come on top of `_PROGRAM_RULES`."""


def names() -> tuple[str, ...]:
    """Return the names of all games that `game` can make: the published boards, then the games of the
    literature."""
    return *BOARDS, *LITERATURE_GAMES


def check_game_source(source: str) -> None:
    """Raise a ValueError for a word that names no game and no existing path.

    The path is that of a run's directory or of a file with a drawing; whether it is one is not checked here.
    """
    if source not in names() and not Path(source).exists():
        raise refusal("board", source, f"{', '.join(names())}, a run's directory, or a file with a drawing")


def game(name: str, *, variant: Variant = "published") -> "Game":
    """Return a game by its name, e.g. `game("commons")` or `game("ssd/harvest-v1")`.

    The names of games of the literature end with a version and never change their meaning. `docs/games.md`
    lists all games.

    Args:
        name: one of `names()`.
        variant: "published" for the rules in the text of the study, "as_run" for those of its program. Games
            of the literature only have "published".

    Raises:
        ValueError: for an unknown name, or a variant that the game lacks.
    """
    if name not in names():
        raise refusal("name", name, ", ".join(names()))
    checked("variant", variant, Variant)
    if name in LITERATURE_GAMES:
        if variant != "published":
            raise refusal("variant", variant, f'"published" with {name}, which has no other')
        return game_of_literature(name)
    from cprl.commons import maps
    from cprl.commons.game import Game
    from cprl.commons.quirks import Quirks2019
    from cprl.commons.rules import Rules

    program_rules = {} if variant == "published" else {**_PROGRAM_RULES, "quirks": Quirks2019()}
    return Game(map=maps.published(name), rules=Rules(**program_rules, **_BOARD_RULES[name][variant]))
