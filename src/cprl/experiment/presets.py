"""The published games and hyperparameters by name, as in the text of the study and as in its program."""

from dataclasses import replace
from typing import TYPE_CHECKING

from cprl.commons.named_games import (
    BOARDS as BOARDS,
    GAMES as GAMES,
    VARIANTS as VARIANTS,
    Board as Board,
    Variant as Variant,
    game as game,
    names as names,
)
from cprl.values import checked

if TYPE_CHECKING:
    from cprl.envs.gymnasium_env import CommonsGymnasiumEnv
    from cprl.envs.pettingzoo_env import CommonsParallelEnv
    from cprl.learners.settings import DQNSettings


def gymnasium_env(
    name: str, *, variant: Variant = "published", seed: int | None = None, render_mode: str | None = None
) -> "CommonsGymnasiumEnv":
    """Return a published game with one agent as a Gymnasium environment, for `gymnasium.make`."""
    from cprl.commons.maps import with_agents
    from cprl.envs.gymnasium_env import CommonsGymnasiumEnv

    played = game(name, variant=variant)
    alone = replace(played, map=with_agents(played.map, 1))
    return CommonsGymnasiumEnv(alone, seed=seed, render_mode=render_mode)


def pettingzoo_env(
    name: str, *, variant: Variant = "published", seed: int | None = None, render_mode: str | None = None
) -> "CommonsParallelEnv":
    """Return a published game as a PettingZoo environment, for `pettingzoo.make`."""
    from cprl.envs.pettingzoo_env import CommonsParallelEnv

    return CommonsParallelEnv(game(name, variant=variant), seed=seed, render_mode=render_mode)


def dqn_settings(board: Board, *, variant: Variant = "published") -> "DQNSettings":
    """Return the hyperparameters of the DQN agents on a board.

    The text gives the decay of epsilon on `commons` as 1,000,000 steps; versions of the program have
    500,000, 1,000,000 and, the last one, 5,000,000. All variants use the value of the text. Versions of the
    program also had other discounts, optimisers and losses: `replace(dqn_settings("commons",
    variant="as_run"), gamma=0.997, optimizer="keras_rmsprop")` with `DQN(..., loss_function="log_cosh")`.
    """
    from cprl.learners.settings import DQNSettings

    checked("board", board, Board)
    checked("variant", variant, Variant)
    decay_steps = 1_000_000 if board == "commons" else 500_000
    settings = DQNSettings(gamma=0.995, epsilon_decay_steps=decay_steps)
    if variant == "published":
        return settings
    return replace(
        settings,
        relu_on_outputs=True,
        glorot_uniform=True,
        adam_eps=1e-7,
        own_target_weights=True,
        mean_over_all_outputs=True,
    )


def variant_of(played: object) -> Variant | None:
    """Return the variant of a published game, with or without a beam; None for any other game."""
    from cprl.commons.game import Game

    if not isinstance(played, Game) or played.institutions:
        return None
    for board, variant in GAMES:
        published = game(board, variant=variant)
        rules = replace(played.rules, may_fire=published.rules.may_fire)
        if (played.map, rules, played.observation) == (published.map, published.rules, published.observation):
            return variant
    return None
