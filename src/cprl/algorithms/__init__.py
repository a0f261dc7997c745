"""Learning algorithms: frozen dataclasses, each with TorchRL's loss over its networks.

Modules, in the order in which one reads them:
    base          Algorithm, OffPolicy, OnPolicy, TeamAlgorithm: the base classes, also for your own
    off_policy    DQN and its variants, C51, CQL, SAC, IQL; PR2, which sees the actions of its peers; tables
    on_policy     PPO, A2C, REINFORCE
    teams         VDN, QMIX, MAPPO, IPPO, MADDPG, LOLA
"""

from cprl.algorithms.base import Algorithm, OffPolicy, OnPolicy, TeamAlgorithm
from cprl.algorithms.off_policy import CQL, DQN, IQL, PR2, SAC, DistributionalDQN, Tabular
from cprl.algorithms.on_policy import A2C, PPO, Reinforce
from cprl.algorithms.teams import IPPO, LOLA, MADDPG, MAPPO, QMIX, VDN
from cprl.learners.settings import DQNSettings, LOLASettings, RolloutSettings, TabularSettings

__all__ = [
    "A2C",
    "CQL",
    "DQN",
    "IPPO",
    "IQL",
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
    "DistributionalDQN",
    "LOLASettings",
    "OffPolicy",
    "OnPolicy",
    "Reinforce",
    "RolloutSettings",
    "Tabular",
    "TabularSettings",
    "TeamAlgorithm",
]
