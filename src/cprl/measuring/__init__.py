"""From what happened to what it meant: the social metrics, and whole episodes out of collected batches.

Modules, in the order in which one reads them:
    social        the social metrics, from the totals of an episode
    institutions  metrics of institutions, likewise
    metrics       their names, words and units, and what is left out where a game does not report an entry
    episodes      Episode, and EpisodeTracker, which makes them of batches of turns; metrics of the user's own
    evaluate      one fresh episode in every world, without learning
    statistics    estimates over replicas, with intervals by Student's t
    series        numbers while a training runs
    outcome       how a training goes, and how it went
    movement      where agents go, which cells they share or keep, and who tags whom
"""

from cprl.measuring import social
from cprl.measuring.episodes import Episode, EpisodeTracker

__all__ = ["Episode", "EpisodeTracker", "social"]
