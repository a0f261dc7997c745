"""Adapter for Gymnasium: play games that have a single agent.

Importing `cprl` registers `cprl/SingleBasic-v0`, `cprl/SingleComplex-v0` and, for any game with one agent,
`cprl/Commons-v0`.
"""

from typing import Any

import gymnasium

from cprl.commons.game import Game
from cprl.envs.pettingzoo_env import RENDER_FPS, RENDER_MODES, CommonsParallelEnv
from cprl.values import Seed, checked
from cprl.values.array_types import UInt8


class CommonsGymnasiumEnv(gymnasium.Env[Any, Any]):
    """One world of a game with one agent as a Gymnasium `Env`.

    `CommonsParallelEnv` plays the world: seeds, render modes, decisions and infos are as described there.
    """

    metadata = {  # noqa: RUF012  (as Gymnasium declares it)
        "render_modes": list(RENDER_MODES),
        "render_fps": RENDER_FPS,
    }

    def __init__(self, game: Game, *, seed: int | None = None, render_mode: str | None = None) -> None:
        if game.agents != 1:
            raise ValueError(
                f"the game has {game.agents} agents; allowed with Gymnasium: 1; for more use "
                "cprl.envs.parallel_env (PettingZoo) or CommonsEnv (TorchRL)"
            )
        self.game = game
        self.render_mode = render_mode
        self.world = CommonsParallelEnv(game, seed=seed, render_mode=render_mode)
        (self.observation_space,) = self.world.observation_spaces.values()
        (self.action_space,) = self.world.action_spaces.values()

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.game!r})"

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[UInt8, dict[str, Any]]:
        """Begin the next episode, or the first episode of a new seed."""
        super().reset(seed=checked("seed", seed, Seed | None))
        self.world.reset(seed, options)
        return self.world.observation(0), self.world.info(0)

    def step(self, action: int) -> tuple[UInt8, float, bool, bool, dict[str, Any]]:
        """Play one turn; raise a ValueError for an unknown action, and leave the world unchanged."""
        world = self.world
        world.play([action])
        return world.observation(0), world.reward(0), world.terminated, world.truncated, world.info(0)

    def render(self) -> UInt8:
        """Return an image of the board, uint8 [rows, columns, 3]; refuse to without a render mode."""
        return self.world.render()
