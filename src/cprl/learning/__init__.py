"""From what happened to better values: transitions of one agent, and the learners that use them."""

from cprl.learning.dqn import DQNLearner
from cprl.learning.settings import DQNSettings
from cprl.learning.transitions import transitions_of

__all__ = ["DQNLearner", "DQNSettings", "transitions_of"]
