"""Learning algorithms: frozen dataclasses, each with TorchRL's loss over its networks.

Modules, in the order in which one reads them:
    base            Algorithm, OffPolicy, OnPolicy, TeamAlgorithm: the base classes, also for your own
    dqn, sac, pr2   learn from replay
    ppo, a2c, reinforce        learn from rollouts
    vdn, qmix, mappo, ippo, maddpg, lola   teams
    tabular         Q-learning in tables
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
