"""From what happened to what it meant: the social metrics, and whole episodes out of collected batches."""

from cprl.measuring import social
from cprl.measuring.episodes import Episode, EpisodeTracker

__all__ = ["Episode", "EpisodeTracker", "social"]
