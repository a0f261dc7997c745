"""Matrix games: agents choose at once and are paid by a table, once or for several turns.

Modules, in the order in which one reads them:
    game       MatrixGame, a payoff table as a value
    published  the prisoner's dilemma and others by name
    env        MatrixEnv, TorchRL: B worlds at once
"""

from cprl.envs.matrix.env import MatrixEnv
from cprl.envs.matrix.game import MatrixGame
from cprl.envs.matrix.published import chicken, matching_pennies, prisoners_dilemma, stag_hunt

__all__ = ["MatrixEnv", "MatrixGame", "chicken", "matching_pennies", "prisoners_dilemma", "stag_hunt"]
