"""From what happened to what it meant: one registry of what is measured, and functions of tables.

Modules, in the order in which one reads them:
    social        the formulas of the metrics
    welfare       what a governor wants of a period or an episode
    registry      every total and every metric, each said once: words, unit, formula, bounds, colour
    tracker       Episode, and EpisodeTracker, which makes them of batches of turns; metrics of the user's own
    playing       one fresh episode in every world, without learning, turn by turn
    table         tidy tables of episodes: their rows, labels and numbers
    windows       means over windows of episodes, in which every world counts alike
    statistics    estimates over replicas and differences, with intervals by Student's t, and Holm's families
    series        numbers while a training runs
    outcome       how a training went
    live_label    how a running training goes
"""

from cprl.measuring import social
from cprl.measuring.tracker import Episode, EpisodeTracker

__all__ = ["Episode", "EpisodeTracker", "social"]
