"""Adapters for PettingZoo: all agents at once (`parallel_env`), or one after the other (`env`)."""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils import parallel_to_aec

from cprl import arguments
from cprl.checks import shown
from cprl.commons.game import Game
from cprl.commons.world import Bytes
from cprl.envs.one_world import RENDER_FPS, RENDER_MODES, Observed, OneWorld

Infos = dict[str, dict[str, Any]]


class CommonsParallelEnv(ParallelEnv[str, Any, int]):
    """One world of a game as a PettingZoo `ParallelEnv`; agents are agent_0, agent_1, ...

    Every agent acts in every turn until the episode ends for all; the action of an agent out of play has no
    effect. `infos` holds each agent's "harvest", whether it acts in the coming turn ("in_play"), whether it
    "fired" and whether it was "tagged"; with institutions also its "fines", "transfers" and whether it
    "violated" a rule.

    Args:
        game: The game, see `presets.game`.
        seed: The seed of all random numbers, 0 to 2**64 - 1; `reset(seed=...)` restarts with another one.
            None draws one from torch's generator, another for each environment, as `CommonsEnv` does.
        render_mode: "rgb_array" or None.

    Raises:
        ValueError: If the seed or the render mode is not allowed.
    """

    metadata: ClassVar[dict[str, Any]] = {
        "name": "commons_v0",
        "render_modes": list(RENDER_MODES),
        "render_fps": RENDER_FPS,
        "is_parallelizable": True,
    }

    def __init__(self, game: Game, *, seed: int | None = None, render_mode: str | None = None) -> None:
        arguments.object_of("game", game, Game, "a cprl.Game")
        self.game, self.render_mode = game, render_mode
        self.world = OneWorld(game, seed=seed, render_mode=render_mode)
        self.possible_agents = list(game.agent_names)
        self.agents: list[str] = []
        self.observation_spaces = {name: self.world.observation_space() for name in self.possible_agents}
        self.action_spaces = {name: spaces.Discrete(len(game.actions)) for name in self.possible_agents}
        self.state_space = spaces.Box(0, 255, (3, game.map.height, game.map.width), np.uint8)

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """A Box of uint8 [C, X, Y], or a Dict that holds it as "observation"; always the same object."""
        arguments.choice("agent", agent, self.possible_agents)
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """A Discrete space, the indices of `Game.actions`; always the same object."""
        arguments.choice("agent", agent, self.possible_agents)
        return self.action_spaces[agent]

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.game!r})"

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observed], Infos]:
        """Begins the next episode, or the first episode of a new seed.

        Args:
            seed: The new seed, or None for the next episode.
            options: "decisions", a dict by agent, is what agents decide in this episode where institutions
                ask them (`Game.decisions` options, the first one by default); others are ignored.
        """
        self.world.begin(seed, (options or {}).get("decisions"))
        self.agents = list(self.possible_agents)
        return self._observations(), self._infos()

    def step(
        self, actions: dict[str, int]
    ) -> tuple[dict[str, Observed], dict[str, float], dict[str, bool], dict[str, bool], Infos]:
        """Plays one turn with one action per agent.

        Raises:
            ValueError: If an action is missing, superfluous, no integer or out of range, or the episode has
                not begun or has ended; the world is unchanged.
        """
        arguments.object_of("actions", actions, Mapping, "a dict with an action for each agent")
        self.world.check_begun("the first step")
        if not self.agents:
            raise ValueError("the episode has ended; allowed: reset() before the next step")
        if set(actions) != set(self.agents):
            raise ValueError(f"actions has the agents {shown(list(actions))}; allowed: exactly {self.agents}")
        self.world.play([actions[name] for name in self.agents])
        rewards = {name: self.world.reward(i) for i, name in enumerate(self.agents)}
        terminations = dict.fromkeys(self.agents, self.world.terminated)
        truncations = dict.fromkeys(self.agents, self.world.truncated)
        output = self._observations(), rewards, terminations, truncations, self._infos()
        if self.world.terminated or self.world.truncated:
            self.agents = []
        return output

    def state(self) -> Bytes:
        """The whole board in RGB: uint8 [3, H, W]."""
        return self.world.state()

    def render(self) -> Bytes:
        """Return an image, uint8 [rows, columns, 3].

        Raises:
            ValueError: If there is no render mode.
        """
        return self.world.render()

    def _observations(self) -> dict[str, Observed]:
        return {name: self.world.observation(i) for i, name in enumerate(self.agents)}

    def _infos(self) -> Infos:
        return {name: self.world.info(i) for i, name in enumerate(self.agents)}


def parallel_env(
    game: Game, seed: int | None = None, *, render_mode: str | None = None
) -> CommonsParallelEnv:
    """The game as a PettingZoo `ParallelEnv`; see `CommonsParallelEnv`."""
    return CommonsParallelEnv(game, seed=seed, render_mode=render_mode)


def env(game: Game, seed: int | None = None, *, render_mode: str | None = None) -> AECEnv[str, Any, int]:
    """The game as a PettingZoo `AECEnv`: agents act one by one; a turn is played after the last has acted."""
    return parallel_to_aec(parallel_env(game, seed, render_mode=render_mode))
