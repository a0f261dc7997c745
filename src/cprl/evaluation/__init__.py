"""Evaluation: the agents of stored runs in fresh worlds, among themselves and among each other."""

from cprl.evaluation.cross_play import Cell, CrossPlay, crossplay
from cprl.evaluation.evaluate import Evaluation, evaluate_run

__all__ = ["Cell", "CrossPlay", "Evaluation", "crossplay", "evaluate_run"]
