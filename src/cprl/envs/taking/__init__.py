"""Games of people who share a resource: agents choose at once how much they take, once or for several turns.

Modules, in the order in which one reads them:
    game  TakingGame, a `cprl.theory.SharingGame` as something that agents play
    env   TakingEnv, TorchRL: B worlds at once
"""

from cprl.envs.taking.env import TakingEnv
from cprl.envs.taking.game import TakingGame

__all__ = ["TakingEnv", "TakingGame"]
