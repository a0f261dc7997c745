"""Defaults that functions share with the command line, which answers without importing the functions."""

from dataclasses import dataclass
from typing import Final, Literal

from cprl.values import Natural, Positive, Seed, Value

SEED: Final = 30_011
"""The seed of fresh worlds; no training of ours uses it, nor the next ones."""
FILM_SEED: Final = 20_011
"""The seed of filmed episodes."""
FILM_SUFFIXES: Final = (".gif", ".mp4")
"""Of the names of films."""
PLAY_SEED: Final = 40_011
"""The seed where a person plays."""
BLOCK: Final = 8
"""Replicas that one run trains side by side, if a study does not say."""
LAST: Final = 30
"""Episodes at the end of a training that are compared, unless something else is asked for."""
WINDOW: Final = 10
"""Episodes of a window of a study's table, unless something else is asked for."""
STUDY_TABLE: Final = "table.parquet"
"""The file of a study's table, in its directory."""
SANDBOX_EPISODES: Final = 150
"""Of a training in the sandbox."""
EGTA_RESAMPLES: Final = 200
"""Resamples of the replicas for intervals of an empirical game."""

Diagonal = Literal["self", "cross_seed"]
"""Whom a run's agents meet in the cross-play with their own run."""


@dataclass(frozen=True, kw_only=True)
class Fresh(Value, stored=False):
    """Which fresh worlds are played, and how."""

    episodes: Positive = 20
    """Episodes of each replica, in each choice of who plays where, each in its own world."""
    seed: Seed = SEED
    """Of the worlds and all chance; the same one gives the same numbers."""
    replicas: tuple[Natural, ...] = ()
    """Which replicas play, by number; by default all that every run has, and 0 to 7 of scripted agents. A
    replica's episodes do not depend on the others."""
    greedy: bool = False
    """Whether stored agents take their best action; else those with action values explore with the run's
    `epsilon_evaluation`, and those with a policy draw from it."""

    def __str__(self) -> str:
        counts = {"replica": len(self.replicas), "episode": self.episodes}
        return ", ".join(f"{count} {name}{'s' * (count != 1)}" for name, count in counts.items()) + " each"
