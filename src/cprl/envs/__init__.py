"""Adapters of the same game: TorchRL, PettingZoo, Gymnasium.

Modules, in the order in which one reads them:
    make_env         where an environment is put together; spaces_of; games as recipes hold them
    commons_env      CommonsEnv, TorchRL: B worlds at once
    drivers          where the worlds run: CPU threads or a GPU
    stepping          what environments share in a step: actions, what is carried on
    unwrap           what lies under an environment's transforms, and what its specs say of agents
    state            the state of an environment and its transforms, for checkpoints
    pettingzoo_env   parallel_env and env, one world
    gymnasium_env    one world of one agent, played by the parallel_env
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
