"""Training: the loop, the agents of a population, and a run from its experiment to its report.

Modules, in the order in which one reads them:
    learning    losses and shaped returns of the running episodes; whom a training accepts
    nan_check   what is NaN or infinite in a training, found and named
    governing   a governor in a training: what it decides by, its periods, how it learns
    training    Training: one step after the other, with a state that can be read and set; train; callbacks
    pools       PoolActor: an agent that is played by another opponent in each episode
    stored      load: agents that an earlier run learned, and how they play
    agents      Population: the agents of an experiment, of whatever kind
    evaluating  what is made of an experiment, and the trained agents in fresh worlds
    running     run: an experiment from its learners to its report
"""

from cprl.runs.schedule import Schedule
from cprl.training.training import Callback, MakeCollector, Training, train

__all__ = ["Callback", "MakeCollector", "Schedule", "Training", "train"]
