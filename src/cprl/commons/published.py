"""Games by name: the published boards with their rules, and the games of the literature.

The published games are those of [W] M. Wiatrak, "Governing the Commons with Multi-Agent Reinforcement
Learning" (2019). All numbers come from its appendix A, and from the parameters and behaviour of its program.
The modules of the game are imported only when a game is made, so that command lines are checked quickly.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, get_args

from cprl.commons.literature import SOURCES, game_of_literature
from cprl.values import checked, refusal

if TYPE_CHECKING:
    from cprl.commons.game import Game

Board = Literal["single_basic", "single_complex", "two_complex", "commons"]
"""The names of the published boards."""
Variant = Literal["published", "as_run"]
"""The variants of a published game: with the rules in the text of the study, or those of its program."""

BOARDS: Final[tuple[Board, ...]] = get_args(Board)
VARIANTS: Final[tuple[Variant, ...]] = get_args(Variant)

TO_THE_EDGE_CELLS: Final = 7
"""A beam of this length crosses all rows of `two_complex`."""

_AS_RUN: Final[dict[str, Any]] = {"hits_to_tag": 2, "clashes": "pairwise", "growth": "before_bites"}
"""The rules of all games "as_run", which also have the group of rules `Quirks2019`."""
_TWO_AS_RUN: Final[dict[str, Any]] = {
    "window_rows": 5,
    "beam_length_cells": (TO_THE_EDGE_CELLS, 6, TO_THE_EDGE_CELLS, 7),
}
_BOARD_RULES: Final[dict[tuple[Board, Variant], dict[str, Any]]] = {
    ("single_basic", "published"): {"may_fire": False},
    ("single_complex", "published"): {"may_fire": False},
    ("two_complex", "published"): {},
    ("commons", "published"): {"window_rows": 7, "window_columns": 15, "beam_length_cells": 6},
    ("single_basic", "as_run"): {"window_rows": 5, "may_fire": False},
    ("single_complex", "as_run"): {"window_rows": 5, "may_fire": False},
    ("two_complex", "as_run"): _TWO_AS_RUN,
    ("commons", "as_run"): {"window_rows": 7, "window_columns": 15, "beam_length_cells": 6},
}
GAMES: Final[tuple[tuple[Board, Variant], ...]] = tuple(_BOARD_RULES)
"""The published games: each board with each of its variants."""


def names() -> tuple[str, ...]:
    """Return the names of all games that `game` can make: the published boards, then the games of the
    literature."""
    return *BOARDS, *SOURCES


def check_board(board: str) -> None:
    """Raise a ValueError for a word that names no game, no run's directory and no file."""
    if board not in names() and not Path(board).exists():
        raise refusal("board", board, f"{', '.join(names())}, a run's directory, or a file with a drawing")


def game(name: str, *, variant: Variant = "published") -> "Game":
    """Return a game by its name, e.g. `game("commons")` or `game("ssd/harvest-v1")`.

    The names of games of the literature end with a version and never change their meaning. `docs/games.md`
    lists all games.

    Args:
        name: one of `names()`.
        variant: "published" for the rules in the text of the study, "as_run" for those of its program. Games
            of the literature only have "published".
    """
    if name in SOURCES:
        if variant != "published":
            raise refusal("variant", variant, f'"published" with {name}, which has no other')
        return game_of_literature(name)
    from cprl.commons import maps
    from cprl.commons.game import Game
    from cprl.commons.quirks import Quirks2019
    from cprl.commons.rules import Rules

    if name not in BOARDS:
        raise refusal("board", name, ", ".join(names()))
    board = check_variant(name, variant)
    as_run = {} if variant == "published" else {**_AS_RUN, "quirks": Quirks2019()}
    return Game(map=maps.published(board), rules=Rules(**as_run, **_BOARD_RULES[board, variant]))


def check_variant(board: str, variant: Variant) -> Board:
    """Return the name of a published board; raise a ValueError for other names, or variants that it lacks."""
    published_board: Board = checked("board", board, Board)
    checked("variant", variant, Variant)
    if (published_board, variant) not in GAMES:
        allowed = ", ".join(
            repr(game_variant) for game_board, game_variant in GAMES if game_board == published_board
        )
        raise refusal(f"variant of {published_board}", variant, allowed)
    return published_board
