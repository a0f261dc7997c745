"""Doors into the same game: TorchRL here, PettingZoo and Gymnasium to come."""

from cprl.envs.torchrl_env import CommonsEnv

__all__ = ["CommonsEnv"]
