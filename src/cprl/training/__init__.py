"""Training: the loop, the agents of a population, and a run from its experiment to its report.

Modules, in the order in which one reads them:
    collectors     one step of all worlds after the other
    callbacks      what is called while a training runs
    finite         what is NaN or infinite in a training, found and named
    training       Training: one step after the other, with a state that can be read and set; train
    stored_agents  agents of stored runs, as policies
    stored         load: a run built again from its directory
    earlier        agents of earlier runs: that play, and that others start from
    agents         the learners and policies of a population
    outcome        what is made of an experiment, and the trained agents in fresh worlds
    running        run: an experiment from its learners to its report
"""

from cprl.training.callbacks import Callback
from cprl.training.training import MakeCollector, Training, train

__all__ = ["Callback", "MakeCollector", "Training", "train"]
