"""Learning algorithms: frozen dataclasses of hyperparameters, which make the networks and the loss of agents.

Modules, in the order in which one reads them:
    base                 the base classes, from which you can also derive an algorithm of your own
    dqn, sac, pr2        algorithms of independent agents that learn from replay
    ppo, a2c, reinforce  algorithms of independent agents that learn from rollouts
    vdn, qmix, mappo, ippo, maddpg, lola  algorithms of teams
    tabular              Q-learning in tables
"""

from cprl.algorithms.a2c import A2C
from cprl.algorithms.base import Algorithm, OffPolicy, OnPolicy, TeamAlgorithm
from cprl.algorithms.dqn import DQN
from cprl.algorithms.ippo import IPPO
from cprl.algorithms.lola import LOLA
from cprl.algorithms.maddpg import MADDPG
from cprl.algorithms.mappo import MAPPO
from cprl.algorithms.ppo import PPO
from cprl.algorithms.pr2 import PR2
from cprl.algorithms.qmix import QMIX
from cprl.algorithms.reinforce import Reinforce
from cprl.algorithms.sac import SAC
from cprl.algorithms.tabular import Tabular
from cprl.algorithms.vdn import VDN
from cprl.learners.settings import DQNSettings, LOLASettings, RolloutSettings, TabularSettings

__all__ = [
    "A2C",
    "DQN",
    "IPPO",
    "LOLA",
    "MADDPG",
    "MAPPO",
    "PPO",
    "PR2",
    "QMIX",
    "SAC",
    "VDN",
    "Algorithm",
    "DQNSettings",
    "LOLASettings",
    "OffPolicy",
    "OnPolicy",
    "Reinforce",
    "RolloutSettings",
    "Tabular",
    "TabularSettings",
    "TeamAlgorithm",
]
