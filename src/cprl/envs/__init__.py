"""Doors into the same game: TorchRL, PettingZoo, Gymnasium."""

from cprl.envs.commons_env import CommonsEnv
from cprl.envs.gymnasium_env import CommonsGymnasiumEnv, register
from cprl.envs.pettingzoo_env import CommonsParallelEnv, env, parallel_env

__all__ = ["CommonsEnv", "CommonsGymnasiumEnv", "CommonsParallelEnv", "env", "parallel_env"]

register()
