"""Learning algorithms: frozen dataclasses, each with TorchRL's loss over its networks.

Modules, in the order in which one reads them:
    base          Algorithm, OffPolicy, OnPolicy, TeamAlgorithm: the base classes, also for your own
    dqn           DQN and its variants, C51, CQL
    actor_critic  SAC, IQL
    on_policy     PPO, A2C, REINFORCE
    teams         VDN, QMIX, MAPPO, IPPO
    lola          LOLA, by policy gradients or DiCE
    tabular       tabular Q-learning
"""

from cprl.algorithms.actor_critic import IQL, SAC
from cprl.algorithms.base import Algorithm, OffPolicy, OnPolicy, TeamAlgorithm
from cprl.algorithms.dqn import CQL, DQN, DistributionalDQN
from cprl.algorithms.lola import LOLA
from cprl.algorithms.on_policy import A2C, PPO, Reinforce
from cprl.algorithms.tabular import Tabular
from cprl.algorithms.teams import IPPO, MAPPO, QMIX, VDN
from cprl.learners.lola.settings import LOLASettings
from cprl.learners.settings import DQNSettings, RolloutSettings, TabularSettings

__all__ = [
    "A2C",
    "CQL",
    "DQN",
    "IPPO",
    "IQL",
    "LOLA",
    "MAPPO",
    "PPO",
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
