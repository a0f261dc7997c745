"""The published boards with their rules, as in the text of the study and as in its program.

Every number is from [W] M. Wiatrak, "Governing the Commons with Multi-Agent Reinforcement Learning" (2019),
its appendix A, and the parameters and behaviour of the study's program. The game is imported when it is made,
so that command lines are checked without it.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, get_args

from cprl.commons.literature import SOURCES
from cprl.commons.literature import game as game_of_literature
from cprl.values import checked, refusal

if TYPE_CHECKING:
    from cprl.commons.game import Game

Board = Literal["single_basic", "single_complex", "two_complex", "commons"]
Variant = Literal["published", "as_run"]

BOARDS: Final[tuple[Board, ...]] = get_args(Board)
VARIANTS: Final[tuple[Variant, ...]] = get_args(Variant)
"""`published`: as in the study's text; `as_run`: as in its program."""

TO_THE_EDGE_CELLS: Final = 7
"""A beam of this length crosses all rows of `two_complex`."""

_AS_RUN: Final[dict[str, Any]] = {"hits_to_tag": 2, "clashes": "pairwise", "growth": "before_bites"}
"""Beside `Quirks2019`."""
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
"""Every board with each of its variants."""


def names() -> tuple[str, ...]:
    """Return the names of all games that `game` knows: the boards of the study, then those of the
    literature."""
    return *BOARDS, *SOURCES


def check_board(board: str) -> None:
    """Refuse a word that names neither a game nor a run's directory nor a file."""
    if board not in names() and not Path(board).exists():
        raise refusal("board", board, f"{', '.join(names())}, a run's directory, or a file with a drawing")


def game(name: str, *, variant: Variant = "published") -> "Game":
    """Return a game by one of `names`: a board of the study, in a variant, or a game of the literature.

    The ids of the latter say their version and never change their meaning; `docs/games.md` has them all.
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
    return Game(map=maps.named(board), rules=Rules(**as_run, **_BOARD_RULES[board, variant]))


def check_variant(board: str, variant: Variant) -> Board:
    """Return the name of a board of the study; refuse others, and variants that it lacks."""
    known: Board = checked("board", board, Board)
    checked("variant", variant, Variant)
    if (known, variant) not in GAMES:
        allowed = ", ".join(repr(other) for of, other in GAMES if of == known)
        raise refusal(f"variant of {known}", variant, allowed)
    return known
