"""Stable-Baselines3's PPO on `commons` through PettingZoo and SuperSuit: four agents share one network."""

from typing import Any

import tyro
from pettingzoo.utils.wrappers import BaseParallelWrapper
from stable_baselines3 import PPO
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecMonitor
from supersuit import concat_vec_envs_v1, pettingzoo_env_to_vec_env_v1

from cprl import Game, presets
from cprl.envs import parallel_env


class TimeLimits(BaseParallelWrapper):
    """A wrapper that marks episodes that the clock ended, which SB3 bootstraps; SuperSuit loses that."""

    def step(self, actions: dict[str, int]) -> tuple[Any, ...]:
        observations, rewards, terminated, truncated, infos = super().step(actions)
        for agent, info in infos.items():
            info["TimeLimit.truncated"] = truncated[agent] and not terminated[agent]
        return observations, rewards, terminated, truncated, infos


def worlds_of(game: Game, worlds: int, seed: int) -> VecMonitor:
    """Return the agents of all worlds, one after the other, as one batch of SB3's."""
    one = pettingzoo_env_to_vec_env_v1(TimeLimits(parallel_env(game)))
    copies = concat_vec_envs_v1(one, worlds, base_class="stable_baselines3")
    copies.venv.reset(seed=seed * worlds)  # a seed for each copy, or all would play the same world
    return VecMonitor(copies)


def main(*, iterations: int = 20, worlds: int = 4, seed: int = 0) -> list[float]:
    """Train on an episode in every world per iteration; return the harvest of an agent in each."""
    set_random_seed(seed)
    game = presets.game("commons")
    turns = game.rules.episode_steps
    agents = worlds * game.agents
    batches = {
        "n_steps": turns,
        "batch_size": turns * agents // 16,
        "n_epochs": 4,
        "stats_window_size": agents,
    }
    model = PPO(
        "MlpPolicy", worlds_of(game, worlds, seed), learning_rate=1e-3, ent_coef=0.01, device="cpu", **batches
    )
    harvests = []
    for iteration in range(iterations):
        model.learn(turns * agents, reset_num_timesteps=iteration == 0)
        finished = [episode["r"] for episode in model.ep_info_buffer]
        harvests.append(float(sum(finished) / len(finished)))
        print(f"iteration {iteration + 1}: an agent harvests {harvests[-1]:.1f} in an episode", flush=True)
    return harvests


if __name__ == "__main__":
    tyro.cli(main)
