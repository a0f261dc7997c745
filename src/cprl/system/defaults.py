"""Defaults that functions share with the command line, which answers without importing the functions."""

from typing import Final, Literal

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
