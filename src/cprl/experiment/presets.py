"""The published games and hyperparameters by name, as in the text of the study and as in its program.

Every number is from [W] M. Wiatrak, "Governing the Commons with Multi-Agent Reinforcement Learning" (2019),
its appendix A, and the parameters and behaviour of the study's program.
"""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, get_args

from cprl.values import checked, refusal

if TYPE_CHECKING:
    from cprl.commons.game import Game
    from cprl.envs.gymnasium_env import CommonsGymnasiumEnv
    from cprl.learners.settings import DQNSettings

Board = Literal["single_basic", "single_complex", "two_complex", "commons"]
Variant = Literal["published", "as_run", "as_run_10_april"]

BOARDS: Final[tuple[Board, ...]] = get_args(Board)
VARIANTS: Final[tuple[Variant, ...]] = get_args(Variant)
"""`published`: as in the study's text; `as_run`: as in its program; `as_run_10_april`: as in its program for
two agents from 10 to 13 April 2019, with a discount of 0.999 and `agent_1_right_moves_agent_0`; `two_complex`
alone has it."""

TO_THE_EDGE_CELLS: Final = 7
"""A beam of this length crosses all rows of `two_complex`."""

_AS_RUN: Final[dict[str, Any]] = {
    "hits_to_tag": 2,
    "pairwise_clashes": True,
    "regrow_before_bites": True,
    "freeze_counts_tag_turn": True,
    "ends_one_turn_late": True,
    "picture_shows_old_stock": True,
    "paint_over": True,
    "mark_behind_if_vertical": True,
    "self_paint_stays": True,
}
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
    ("two_complex", "as_run_10_april"): {**_TWO_AS_RUN, "agent_1_right_moves_agent_0": True},
    ("commons", "as_run"): {"window_rows": 7, "window_columns": 15, "beam_length_cells": 6},
}
GAMES: Final[tuple[tuple[Board, Variant], ...]] = tuple(_BOARD_RULES)
"""Every board with each of its variants."""


def check_board(board: str) -> None:
    """Refuse a word that names neither a published board nor a run's directory nor a file."""
    if board not in BOARDS and not Path(board).exists():
        raise refusal("board", board, f"{', '.join(BOARDS)}, a run's directory, or a file with a drawing")


def game(board: Board, *, variant: Variant = "published") -> "Game":
    from cprl.commons import maps
    from cprl.commons.game import Game
    from cprl.commons.rules import Rules

    _check(board, variant)
    quirks = {} if variant == "published" else _AS_RUN
    return Game(map=maps.named(board), rules=Rules(**quirks, **_BOARD_RULES[board, variant]))


def gymnasium_env(
    board: Board, *, variant: Variant = "published", seed: int | None = None, render_mode: str | None = None
) -> "CommonsGymnasiumEnv":
    """A published board for one agent as a Gymnasium environment, for `gymnasium.make`."""
    from cprl.envs.gymnasium_env import CommonsGymnasiumEnv

    return CommonsGymnasiumEnv(game(board, variant=variant), seed=seed, render_mode=render_mode)


def dqn_settings(board: Board, *, variant: Variant = "published") -> "DQNSettings":
    """The hyperparameters of the DQN agents on a board.

    The text gives the decay of epsilon on `commons` as 1,000,000 steps; versions of the program have
    500,000, 1,000,000 and, the last one, 5,000,000. All variants use the value of the text. Versions of the
    program also had other discounts, optimisers and losses: `replace(dqn_settings("commons",
    variant="as_run"), gamma=0.997, optimizer="keras_rmsprop")` with `DQN(..., loss_function="log_cosh")`.
    """
    from cprl.learners.settings import DQNSettings

    _check(board, variant)
    as_run = variant != "published"
    return DQNSettings(
        gamma=0.999 if variant == "as_run_10_april" else 0.995,
        epsilon_decay_steps=1_000_000 if board == "commons" else 500_000,
        relu_on_outputs=as_run,
        glorot_uniform=as_run,
        adam_eps=1e-7 if as_run else 1e-8,
        own_target_weights=as_run,
        mean_over_all_outputs=as_run,
    )


def variant_of(played: object) -> Variant | None:
    """The variant of a published game, whether agents may fire or not; None for any other game."""
    from cprl.commons.game import Game

    if not isinstance(played, Game) or played.institutions:
        return None
    for board, variant in GAMES:
        published = game(board, variant=variant)
        rules = replace(played.rules, may_fire=published.rules.may_fire)
        if (played.map, rules, played.observation) == (published.map, published.rules, published.observation):
            return variant
    return None


def _check(board: str, variant: str) -> None:
    checked("board", board, Board)
    checked("variant", variant, Variant)
    if (board, variant) not in GAMES:
        allowed = ", ".join(repr(known) for of, known in GAMES if of == board)
        raise refusal(f"variant of {board}", variant, allowed)
