"""The published games and hyperparameters by name, as in the text of the study and as in its program."""

from dataclasses import replace
from typing import TYPE_CHECKING

from cprl.commons.published import BOARDS as BOARDS
from cprl.commons.published import GAMES as GAMES
from cprl.commons.published import VARIANTS as VARIANTS
from cprl.commons.published import Board as Board
from cprl.commons.published import Variant as Variant
from cprl.commons.published import check_variant
from cprl.commons.published import game as game
from cprl.commons.published import names as names

if TYPE_CHECKING:
    from cprl.envs.gymnasium_env import CommonsGymnasiumEnv
    from cprl.envs.pettingzoo_env import CommonsParallelEnv
    from cprl.learners.settings import DQNSettings


def gymnasium_env(
    board: str, *, variant: Variant = "published", seed: int | None = None, render_mode: str | None = None
) -> "CommonsGymnasiumEnv":
    """A game for its first agent alone as a Gymnasium environment, for `gymnasium.make`."""
    from cprl.commons.maps import with_agents
    from cprl.envs.gymnasium_env import CommonsGymnasiumEnv

    played = game(board, variant=variant)
    alone = replace(played, map=with_agents(played.map, 1))
    return CommonsGymnasiumEnv(alone, seed=seed, render_mode=render_mode)


def pettingzoo_env(
    board: str, *, variant: Variant = "published", seed: int | None = None, render_mode: str | None = None
) -> "CommonsParallelEnv":
    """A game as a PettingZoo environment, for `pettingzoo.make`."""
    from cprl.envs.pettingzoo_env import CommonsParallelEnv

    return CommonsParallelEnv(game(board, variant=variant), seed=seed, render_mode=render_mode)


def dqn_settings(board: Board, *, variant: Variant = "published") -> "DQNSettings":
    """The hyperparameters of the DQN agents on a board.

    The text gives the decay of epsilon on `commons` as 1,000,000 steps; versions of the program have
    500,000, 1,000,000 and, the last one, 5,000,000. All variants use the value of the text. Versions of the
    program also had other discounts, optimisers and losses: `replace(dqn_settings("commons",
    variant="as_run"), gamma=0.997, optimizer="keras_rmsprop")` with `DQN(..., loss_function="log_cosh")`.
    """
    from cprl.learners.settings import DQNSettings

    check_variant(board, variant)
    as_run = variant != "published"
    return DQNSettings(
        gamma=0.995,
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
