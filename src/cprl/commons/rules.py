"""Rules: every number of the game, its unit, its range, its source and its switch.

Sources: [W] M. Wiatrak, "Governing the Commons with Multi-Agent Reinforcement Learning" (2019);
[P] Perolat et al. (2017); [run] the program that [W] was run with, where it differs from the text.
`docs/game.md` tells the game in words.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from math import isfinite
from numbers import Integral, Real
from typing import Any, Final, Literal, get_args

ACTIONS: Final = ("forward", "backward", "left", "right", "turn_left", "turn_right", "beam", "stay")
"""What an agent may do, by index; where nobody may fire there is no "beam" and 6 is "stay"."""

Norm = Literal["euclidean", "manhattan", "chebyshev"]


@dataclass(frozen=True, kw_only=True)
class Rules:
    """The numbers of a game. Defaults are those of `published`; every quirk of the study as run is off.

    Lists and arrays are kept as tuples, so that rules compare, hash and print.

    Raises:
        ValueError: names the field, what came and what is allowed.
    """

    regrow_prob: tuple[float, ...] = (0.0, 0.01, 0.01, 0.05, 0.05, 0.1)
    """Probability per turn that an empty site grows an apple, by the number of apples near it [W];
    the last one also holds for every larger number. Each in 0..1."""

    regrow_radius_cells: float = 2.0
    """How far apples count as near, in cells by `regrow_norm`, the rim included [W]. At least 0."""

    regrow_norm: Norm = "euclidean"
    """How that distance is measured [W]."""

    beam_length_cells: int | tuple[int, int, int, int] = 5
    """Cells that a beam reaches ahead, at least 1; one number, or four by heading: up, right, down, left."""

    beam_width_cells: int = 3
    """Cells across a beam, odd, at least 1 [W]."""

    hits_to_tag: int = 1
    """Hits, at most one per turn, that put an agent out of play [W]; 2 in [run]. At least 1."""

    freeze_steps: int | tuple[tuple[int, ...], ...] = 25
    """Turns that a tagged agent misses [W], at least 0. One number, or a table: a row per shooter, a column
    per offence of the one tagged (the last column holds for every later one)."""

    may_fire: bool | tuple[bool, ...] = True
    """Who may fire; one answer for all, or one per agent. Where nobody may, there is no beam action."""

    may_bite: tuple[tuple[bool, ...], ...] | None = None
    """Who may bite where: a row per agent, a column per site; None for everybody everywhere."""

    window_rows: int = 6
    """Rows that an agent sees ahead, its own included [W]. At least 1."""

    window_columns: int = 13
    """Columns that an agent sees, itself in the middle: odd, at least 1 [W]."""

    walls_block_sight: bool = False
    """Whether a window shows only cells in line of sight: the straight line between the two centres crosses
    no wall (ours; both studies have no inner walls)."""

    episode_steps: int = 1000
    """Turns after which an episode is truncated [W]. At least 1."""

    shuffle_starts: bool = False
    """Whether agents change places at the start of every episode, each order equally likely (ours)."""

    pairwise_clashes: bool = False
    """[run] All move at once, then pairs of agents in the order of their numbers: two on one cell, or two
    that swapped, go back to where they began the turn, even if a third stands there. Agents out of play
    return at once, onto a taken cell too."""

    regrow_before_bites: bool = False
    """[run] An apple may grow and be bitten in one turn."""

    freeze_counts_tag_turn: bool = False
    """[run] The turn of the tag counts as the first of `freeze_steps`, so one turn less is missed."""

    ends_one_turn_late: bool = False
    """[run] The episode ends when the stock was empty as the turn began."""

    picture_shows_old_stock: bool = False
    """[run] The picture shows the apples as they hung when the turn began."""

    paint_over: bool = False
    """[run] Heading marks are painted over apples and agents of lower numbers, beams over everything."""

    mark_behind_if_vertical: bool = False
    """[run] The heading mark of an agent that faces up or down is painted behind it."""

    self_paint_stays: bool = False
    """[run] Each agent's own cell is painted as "self" in the order of numbers and stays so for the windows
    of later agents, whether it is in play or not."""

    def __post_init__(self) -> None:
        for field in fields(self):
            object.__setattr__(self, field.name, _as_tuples(getattr(self, field.name)))
        for name, (fits, wanted) in _CHECKS.items():
            value = getattr(self, name)
            if not fits(value):
                raise ValueError(f"Rules.{name} is {value!r}; allowed: {wanted}")

    @property
    def beam_lengths_cells(self) -> tuple[int, int, int, int]:
        """`beam_length_cells` by heading: up, right, down, left."""
        length = self.beam_length_cells
        return length if isinstance(length, tuple) else (length,) * 4

    @property
    def has_beam(self) -> bool:
        """Whether anybody may fire, and so whether there is a beam action."""
        return any(self.may_fire) if isinstance(self.may_fire, tuple) else self.may_fire

    @property
    def actions(self) -> tuple[str, ...]:
        """The names of the actions by index: 8, or 7 without a beam."""
        return ACTIONS if self.has_beam else tuple(name for name in ACTIONS if name != "beam")


def _as_tuples(value: Any) -> Any:
    """Lists and arrays as tuples all the way down, numpy scalars as Python's own."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, Sequence) and not isinstance(value, str):
        return tuple(_as_tuples(item) for item in value)
    return value


def _is_count(value: Any, least: int) -> bool:
    return isinstance(value, Integral) and not isinstance(value, bool) and least <= int(value) < 2**31


def _is_odd(value: Any) -> bool:
    return _is_count(value, 1) and value % 2 == 1


def _is_number(value: Any, least: float, most: float) -> bool:
    real = isinstance(value, Real) and not isinstance(value, bool)
    return real and isfinite(value) and least <= value <= most


def _is_table(value: Any, fits: Callable[[Any], bool]) -> bool:
    """A tuple of equally long, non-empty tuples whose entries all fit."""
    if not isinstance(value, tuple) or not value or not all(isinstance(row, tuple) for row in value):
        return False
    return len({len(row) for row in value}) == 1 and all(row and all(map(fits, row)) for row in value)


def _is_bool(value: Any) -> bool:
    return isinstance(value, bool)


def _are_probabilities(value: Any) -> bool:
    return isinstance(value, tuple) and bool(value) and all(_is_number(p, 0, 1) for p in value)


def _are_beam_lengths(value: Any) -> bool:
    if isinstance(value, tuple):
        return len(value) == 4 and all(_is_count(length, 1) for length in value)
    return _is_count(value, 1)


def _are_freezes(value: Any) -> bool:
    return _is_count(value, 0) or _is_table(value, lambda steps: _is_count(steps, 0))


def _may_fire_fits(value: Any) -> bool:
    return _is_bool(value) or (isinstance(value, tuple) and bool(value) and all(map(_is_bool, value)))


_Check = tuple[Callable[[Any], bool], str]
_SWITCHES: Final = (
    "walls_block_sight",
    "shuffle_starts",
    "pairwise_clashes",
    "regrow_before_bites",
    "freeze_counts_tag_turn",
    "ends_one_turn_late",
    "picture_shows_old_stock",
    "paint_over",
    "mark_behind_if_vertical",
    "self_paint_stays",
)
_CHECKS: Final[dict[str, _Check]] = {
    "regrow_prob": (_are_probabilities, "one or more numbers in 0..1"),
    "regrow_radius_cells": (lambda value: _is_number(value, 0, 1000), "a number in 0..1000"),
    "regrow_norm": (lambda value: value in get_args(Norm), f"one of {get_args(Norm)}"),
    "beam_length_cells": (_are_beam_lengths, "a whole number from 1, or four by heading"),
    "beam_width_cells": (_is_odd, "an odd whole number from 1"),
    "hits_to_tag": (lambda value: _is_count(value, 1), "a whole number from 1"),
    "freeze_steps": (_are_freezes, "a whole number from 0, or rows of equal length by shooter and offence"),
    "may_fire": (_may_fire_fits, "True, False or one of them per agent"),
    "may_bite": (
        lambda value: value is None or _is_table(value, _is_bool),
        "None, or a row of True and False per agent, a column per site",
    ),
    "window_rows": (lambda value: _is_count(value, 1), "a whole number from 1"),
    "window_columns": (_is_odd, "an odd whole number from 1"),
    "episode_steps": (lambda value: _is_count(value, 1), "a whole number from 1"),
    **dict.fromkeys(_SWITCHES, (_is_bool, "True or False")),
}
