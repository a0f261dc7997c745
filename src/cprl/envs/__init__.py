"""Doors into the same game: TorchRL, PettingZoo, Gymnasium."""

from cprl.envs.gymnasium_env import CommonsGymnasiumEnv, register
from cprl.envs.pettingzoo_env import CommonsParallelEnv, env, parallel_env
from cprl.envs.torchrl_env import CommonsEnv

__all__ = ["CommonsEnv", "CommonsGymnasiumEnv", "CommonsParallelEnv", "env", "parallel_env"]

register()
