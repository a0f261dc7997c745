"""From what happened to better values: transitions, and the learners that use them."""

from cprl.learning.dqn import DQNLearner
from cprl.learning.lanes import LaneLearner
from cprl.learning.settings import DQNSettings
from cprl.learning.tabular import TabularLearner, TabularSettings
from cprl.learning.transitions import transitions_of

__all__ = ["DQNLearner", "DQNSettings", "LaneLearner", "TabularLearner", "TabularSettings", "transitions_of"]
