"""How much does random play harvest in an episode of a game?"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase

from cprl import keys
from cprl.commons.game import Game
from cprl.envs.commons_env import CommonsEnv
from cprl.measuring.playing import evaluate
from cprl.system.defaults import SEED
from cprl.values.array_types import Float64

EPISODES: Final = 10_000
"""The episodes of random play, unless somebody says."""
WORLDS_AT_ONCE: Final = 2_500


@cache
def random_returns(game: Game, *, episodes: int = EPISODES) -> Float64:
    """Return the collective harvest of each episode in which all agents act at random, float64 [episodes].

    It is the same for the same game, and played once. Episode e is played in world e; its actions are drawn
    for all worlds played at once.

    Args:
        game: a game without institutions, since these are paid for actions.
    """
    # Nobody looks: windows of one cell.
    game = replace(game, rules=replace(game.rules, window_rows=1, window_columns=1))
    parts = []
    for first in range(0, episodes, WORLDS_AT_ONCE):
        env = CommonsEnv(game, min(WORLDS_AT_ONCE, episodes - first), seed=SEED, first_world=first)
        rng = np.random.default_rng([SEED, first])
        parts.append(harvests(env, lambda env, rng=rng: _random_actions(env, rng)))
    return np.concatenate(parts)


def _random_actions(env: CommonsEnv, rng: np.random.Generator) -> NDArray[np.int64]:
    size = (*env.batch_size, env.game.agents)
    return rng.integers(len(env.game.actions), size=size)


def harvests(env: CommonsEnv, choose: Callable[[CommonsEnv], NDArray[Any]]) -> Float64:
    """Return the collective harvest of the next episode of each world, float64 [B], in apples.

    Args:
        env: B worlds.
        choose: the actions of all agents, int64 [B, N], asked for in each turn until all worlds have ended.
    """

    def policy(moment: TensorDictBase) -> TensorDictBase:
        return moment.set(keys.ACTION, torch.from_numpy(choose(env)))

    return np.array([np.sum(episode.harvest) for episode in evaluate(env, policy)], np.float64)
