"""The loop: act, store, update, measure, record.

Modules:
    training    Training: one step after the other, with a state that can be read and set
    loop        train: a training from its first step to its last
"""

from cprl.training.loop import train
from cprl.training.training import MakeCollector, Training

__all__ = ["MakeCollector", "Training", "train"]
