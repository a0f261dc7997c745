"""Evaluation: the agents of stored runs in fresh worlds, among themselves and among each other."""

from cprl.evaluation.runs import Evaluation, evaluate_run
from cprl.evaluation.visits import Cell, CrossPlay, crossplay

__all__ = ["Cell", "CrossPlay", "Evaluation", "crossplay", "evaluate_run"]
