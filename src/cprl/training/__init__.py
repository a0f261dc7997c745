"""Training: the loop, the agents of a population, and a run from its experiment to its report.

Modules, in the order in which one reads them:
    learning    losses and wanted returns of the running episodes; whom a training accepts
    finite      what is NaN or infinite in a training, found and named
    training    Training: one step after the other, with a state that can be read and set; train; callbacks
    agents      the agents of a population; load: those that an earlier run learned
    outcome     what is made of an experiment, and the trained agents in fresh worlds
    course      the course of a run in sentences
    running     run: an experiment from its learners to its report
"""

from cprl.training.training import Callback, MakeCollector, Training, train

__all__ = ["Callback", "MakeCollector", "Training", "train"]
