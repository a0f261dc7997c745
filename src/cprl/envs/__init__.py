"""Environments: the game behind the interfaces of TorchRL, PettingZoo and Gymnasium.

Modules, in reading order:

    make_env         make_env builds an environment of any game, with transforms, and checks it
    commons_env      CommonsEnv: B worlds as one TorchRL environment
    drivers          chooses where the worlds run: on CPU threads or on a GPU
    stepping         helpers of a step: read actions, carry entries over to the next turn
    unwrap           finds the environment under its transforms, its agents and its actions
    env_state        saves and restores an environment and its transforms, for checkpoints
    pettingzoo_env   parallel_env and env: one world for PettingZoo
    gymnasium_env    CommonsGymnasiumEnv: one world with one agent for Gymnasium
"""

from cprl.envs.commons_env import CommonsEnv
from cprl.envs.gymnasium_env import CommonsGymnasiumEnv
from cprl.envs.make_env import make_env, spaces_of
from cprl.envs.pettingzoo_env import CommonsParallelEnv, env, parallel_env

__all__ = [
    "CommonsEnv",
    "CommonsGymnasiumEnv",
    "CommonsParallelEnv",
    "env",
    "make_env",
    "parallel_env",
    "spaces_of",
]
