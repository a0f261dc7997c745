"""Evaluation: the agents of stored runs in fresh worlds, with their own run or in cross-play.

Modules, in the order in which one reads them:
    evaluate    evaluate_run: all replicas of a run, beside the random policy
    cross_play  crossplay: a focal agent of one run among background agents of another
    film        an episode, every step recorded
    lanes       stored agents of all replicas side by side
    same_game   whether two runs can play together
    tables      tables for the terminal
"""

from cprl.evaluation.cross_play import Cell, CrossPlay, crossplay
from cprl.evaluation.evaluate import Evaluation, evaluate_run

__all__ = ["Cell", "CrossPlay", "Evaluation", "crossplay", "evaluate_run"]
