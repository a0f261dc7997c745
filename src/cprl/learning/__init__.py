"""From what happened to better values: algorithms, transitions, and the learners that use them."""

from cprl.learning.algorithms import CQL, DQN, DistributionalDQN
from cprl.learning.dqn import DQNLearner
from cprl.learning.lanes import LaneLearner
from cprl.learning.off_policy_actors import IQL, SAC
from cprl.learning.on_policy import A2C, PPO, Reinforce
from cprl.learning.on_policy_teams import IPPO, MAPPO
from cprl.learning.rollouts import RolloutLearner
from cprl.learning.settings import DQNSettings, RolloutSettings, TabularSettings
from cprl.learning.tabular import Tabular, TabularLearner
from cprl.learning.teams import QMIX, VDN
from cprl.learning.transitions import transitions_of

__all__ = [
    "A2C",
    "CQL",
    "DQN",
    "IPPO",
    "IQL",
    "MAPPO",
    "PPO",
    "QMIX",
    "SAC",
    "VDN",
    "DQNLearner",
    "DQNSettings",
    "DistributionalDQN",
    "LaneLearner",
    "Reinforce",
    "RolloutLearner",
    "RolloutSettings",
    "Tabular",
    "TabularLearner",
    "TabularSettings",
    "transitions_of",
]
