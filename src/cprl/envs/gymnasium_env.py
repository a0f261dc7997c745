"""Adapter for Gymnasium: games of a single agent.

Importing `cprl` registers `cprl/SingleBasic-v0`, `cprl/SingleComplex-v0` and, for any game with one agent,
`cprl/Commons-v0`.
"""

from typing import Any

import gymnasium
from gymnasium import spaces

from cprl import arguments
from cprl.commons.game import Game
from cprl.commons.world import Bytes
from cprl.envs.one_world import RENDER_FPS, RENDER_MODES, Observed, OneWorld


class CommonsGymnasiumEnv(gymnasium.Env[Any, Any]):
    """One world of a game with one agent as a Gymnasium `Env`.

    Args:
        game: The game, see `presets.game`; its map has one agent.
        seed: The seed of all random numbers, 0 to 2**64 - 1; `reset(seed=...)` restarts with another one.
            None draws one from torch's generator, another for each environment, as `CommonsEnv` does.
        render_mode: "rgb_array" or None.

    Raises:
        ValueError: If the game has several agents, or the seed or the render mode is not allowed.
    """

    metadata = {  # noqa: RUF012  (as Gymnasium declares it)
        "render_modes": list(RENDER_MODES),
        "render_fps": RENDER_FPS,
    }

    def __init__(self, game: Game, *, seed: int | None = None, render_mode: str | None = None) -> None:
        arguments.object_of("game", game, Game, "a cprl.Game")
        if game.agents != 1:
            raise ValueError(
                f"the game has {game.agents} agents; allowed with Gymnasium: 1; for more use "
                "cprl.envs.parallel_env (PettingZoo) or CommonsEnv (TorchRL)"
            )
        self.game, self.render_mode = game, render_mode
        self.world = OneWorld(game, seed=seed, render_mode=render_mode)
        self.observation_space = self.world.observation_space()
        self.action_space = spaces.Discrete(len(game.actions))

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.game!r})"

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observed, dict[str, Any]]:
        """Begins the next episode, or the first episode of a new seed."""
        super().reset(seed=None if seed is None else arguments.seed(seed))
        self.world.begin(seed, (options or {}).get("decisions"))
        return self.world.observation(0), self.world.info(0)

    def step(self, action: int) -> tuple[Observed, float, bool, bool, dict[str, Any]]:
        """Plays one turn; `info` holds "harvest", "in_play", "fired" and "tagged".

        Raises:
            ValueError: If the action is no integer or out of range, or the episode has not begun; the world
                is unchanged.
        """
        world = self.world
        world.play([action])
        return world.observation(0), world.reward(0), world.terminated, world.truncated, world.info(0)

    def render(self) -> Bytes:
        """Return an image, uint8 [rows, columns, 3].

        Raises:
            ValueError: If there is no render mode.
        """
        return self.world.render()
