"""PreferenceWrapper: rewards as agents want them, for PettingZoo."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from pettingzoo import ParallelEnv
from pettingzoo.utils import BaseParallelWrapper

from cprl.arguments import object_of
from cprl.preferences.values import Preference
from cprl.preferences.wanted import WantedRewards


class PreferenceWrapper(BaseParallelWrapper[str, Any, Any]):
    """A PettingZoo `ParallelEnv` whose agents get the rewards that they want.

    The environment's own reward is in `infos`, as "env_reward". An agent that has left the game counts with a
    reward of 0.

    Args:
        env: the environment, e.g. `cprl.envs.parallel_env(game)`.
        preferences: what all agents want; or a preference for each of `env.possible_agents`.

    Raises:
        ValueError: for what is no parallel environment or no preference, and for preferences that the number
            of agents does not allow.
    """

    def __init__(
        self, env: ParallelEnv[str, Any, Any], preferences: Preference | Sequence[Preference]
    ) -> None:
        object_of("env", env, ParallelEnv, "a ParallelEnv of PettingZoo")
        super().__init__(env)
        self.wants = WantedRewards(preferences)
        self.wants.check_agents(len(env.possible_agents))

    def __repr__(self) -> str:
        return f"PreferenceWrapper({self.env!r})"

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        """Begins the next episode; nothing is remembered of the last one."""
        self.wants.clear()
        first: tuple[dict[str, Any], dict[str, dict[str, Any]]] = self.env.reset(seed=seed, options=options)
        return first

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[dict[str, Any], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Plays one turn."""
        seen, given, terminations, truncations, infos = self.env.step(actions)
        everyone = self.env.possible_agents
        of_turn = np.array([[given.get(agent, 0.0) for agent in everyone]], np.float32)
        wanted = self.wants.add(of_turn, np.zeros(1, np.bool_))[0]
        infos = {
            agent: {**infos.get(agent, {}), "env_reward": float(reward)} for agent, reward in given.items()
        }
        rewards = {agent: float(own) for agent, own in zip(everyone, wanted, strict=True) if agent in given}
        return seen, rewards, terminations, truncations, infos
