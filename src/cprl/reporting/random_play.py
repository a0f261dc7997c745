"""Random play of a game over many episodes: the score that the study's random policy is compared with."""

from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cprl.commons.batch import Batch
from cprl.commons.game import Game
from cprl.commons.playing import harvests
from cprl.evaluation.evaluate import SEED

Values = NDArray[np.float64]

EPISODES: Final = 10_000
WORLDS: Final = 2_500
"""Those played at once."""
PUBLISHED_EPISODES: Final = 100
"""The episodes of the study's random score: its programs of random play, test_random.py, play so many."""


@cache
def returns_by_chance(game: Game, *, episodes: int = EPISODES) -> Values:
    """The collective harvest of each of so many episodes in which all agents act at random, float64
    [episodes].

    The same for the same game, and played once. Episode e is played in world e; its actions are drawn for all
    worlds played at once.

    Args:
        game: a game without institutions, since these are paid for actions.
        episodes: the number of episodes.
    """
    return np.concatenate(
        [_played(game, first, min(WORLDS, episodes - first)) for first in range(0, episodes, WORLDS)]
    )


def _played(game: Game, first: int, worlds: int) -> Values:
    """An episode in each of these worlds."""
    rng = np.random.default_rng([SEED, first])
    size = worlds, game.agents
    batch = Batch(game, worlds, seed=SEED, first_world=first)
    return harvests(batch, lambda _: rng.integers(len(game.actions), size=size))
