"""Defaults that functions share with the command line, which answers without importing the functions."""

from dataclasses import dataclass
from typing import Final, Literal

from cprl.values import Natural, Positive, Seed, Value

SEED: Final = 30_011
"""The seed of fresh worlds; no published training uses it or the seeds after it."""
FILM_SEED: Final = 20_011
"""The seed of filmed episodes."""
FILM_SUFFIXES: Final = (".gif", ".mp4")
"""The endings of the names of films."""
PLAY_SEED: Final = 40_011
"""The seed of games that a person plays."""
REPLICAS_PER_RUN: Final = 8
"""Replicas that one run trains side by side, if a study does not say."""
LAST_EPISODES: Final = 30
"""Episodes at the end of a training that are compared, unless something else is asked for."""
WINDOW_EPISODES: Final = 10
"""Episodes of a window of a study's table, unless something else is asked for."""
STUDY_TABLE: Final = "table.parquet"
"""The file of a study's table, in its directory."""
SANDBOX_EPISODES: Final = 150
"""Episodes of a training in the sandbox."""
EGTA_RESAMPLES: Final = 200
"""Resamples of the replicas for intervals of an empirical game."""

Diagonal = Literal["self", "cross_seed"]
"""The partners of a run's agents in the cross-play with their own run."""


@dataclass(frozen=True, kw_only=True)
class Fresh(Value, stored=False):
    """The fresh worlds in which stored agents play, and how they act."""

    episodes: Positive = 20
    """Episodes of each replica for each assignment of agents, each in its own world."""
    seed: Seed = SEED
    """The seed of the worlds and of all random numbers."""
    replicas: tuple[Natural, ...] = ()
    """The numbers of the replicas that play; by default all that every run has, and 0 to 7 where all agents
    are scripted. A replica's episodes do not depend on the others."""
    greedy: bool = False
    """True if stored agents take their best action; else those with action values explore with the run's
    `epsilon_evaluation`, and those with a policy draw from it."""

    def __str__(self) -> str:
        replicas = f"{len(self.replicas)} replica{'s' * (len(self.replicas) != 1)}"
        return f"{replicas}, {self.episodes} episode{'s' * (self.episodes != 1)} each"
