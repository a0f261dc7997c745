"""RLlib's PPO on `commons` through PettingZoo: four agents, each with a network of its own."""

import os
from typing import Any

import numpy as np
import ray
import tyro
from gymnasium.spaces import Box
from pettingzoo.utils.wrappers import BaseParallelWrapper
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
from ray.tune.registry import register_env

from cprl import presets
from cprl.envs import parallel_env


class FlatWindows(BaseParallelWrapper):
    """Windows as float32 [C * X * Y] of 0 to 1: RLlib's own networks for images want larger ones."""

    def observation_space(self, agent: str) -> Box:
        return Box(0, 1, (self.env.observation_space(agent).sample().size,), np.float32)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        # RLlib's seeds come again in other runners and iterations; a world has its own, drawn from torch.
        windows, infos = self.env.reset(None, options)
        return {agent: np.float32(window.ravel() / 255) for agent, window in windows.items()}, infos

    def step(self, actions: dict[str, int]) -> tuple[Any, ...]:
        windows, *others = self.env.step(actions)
        return {agent: np.float32(window.ravel() / 255) for agent, window in windows.items()}, *others


def main(*, iterations: int = 20, worlds: int = 4, runners: int = 0, seed: int = 0) -> list[float]:
    """Train on an episode in every world of every runner; return an agent's harvest in each iteration."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is sent to Ray's makers
    ray.init("local", num_cpus=1 + runners, include_dashboard=False, object_store_memory=100_000_000)
    game = presets.game("commons")
    frames = max(runners, 1) * worlds * game.rules.episode_steps
    register_env("commons", lambda _: ParallelPettingZooEnv(FlatWindows(parallel_env(game))))
    ppo = PPOConfig().environment("commons").debugging(seed=seed * (runners + 1))  # runner i: this + i
    ppo.env_runners(num_env_runners=runners, num_envs_per_env_runner=worlds, batch_mode="complete_episodes")
    ppo.multi_agent(policies=set(game.agent_names), policy_mapping_fn=lambda agent, *_, **__: agent)
    ppo.rl_module(model_config=DefaultModelConfig(fcnet_hiddens=[64, 64]))
    ppo.training(train_batch_size_per_learner=frames, minibatch_size=frames // 16, num_epochs=4)
    ppo.training(lr=1e-3, gamma=0.99, lambda_=0.95, entropy_coeff=0.01)
    trainer = ppo.build_algo()
    harvests = []
    for iteration in range(iterations):
        harvests.append(float(trainer.train()["env_runners"]["episode_return_mean"]) / game.agents)
        print(f"iteration {iteration + 1}: an agent harvests {harvests[-1]:.1f} in an episode", flush=True)
    trainer.stop()
    ray.shutdown()
    return harvests


if __name__ == "__main__":
    tyro.cli(main)
