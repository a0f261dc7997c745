"""The door of Gymnasium: one agent alone.

Importing `cprl` registers `cprl/SingleBasic-v0`, `cprl/SingleComplex-v0` and, for any game of one agent,
`cprl/Commons-v0`.
"""

from typing import Any

import gymnasium
from gymnasium import spaces

from cprl.commons.game import Game
from cprl.commons.world import Bytes
from cprl.envs.one_world import RENDER_FPS, RENDER_MODES, Observed, OneWorld


class CommonsGymnasiumEnv(gymnasium.Env[Any, Any]):
    """One world of a game for one agent as a Gymnasium `Env`.

    Args:
        game: what is played, see `presets.game`; its map has one agent.
        seed: what all chance follows from; `reset(seed=...)` starts all over with another.
        render_mode: "rgb_array", "human" or None.

    Raises:
        ValueError: for a game of several agents; in `step`, for an unknown action.
    """

    metadata = {  # noqa: RUF012  (Gymnasium's own way)
        "render_modes": list(RENDER_MODES),
        "render_fps": RENDER_FPS,
    }

    def __init__(self, game: Game, *, seed: int = 0, render_mode: str | None = None) -> None:
        if game.agents != 1:
            raise ValueError(
                f"the game has {game.agents} agents; Gymnasium takes one: for more, "
                "cprl.envs.parallel_env (PettingZoo) or CommonsEnv (TorchRL)"
            )
        self.game, self.render_mode = game, render_mode
        self.world = OneWorld(game, seed=seed, title="cprl commons", render_mode=render_mode)
        self.observation_space = self.world.observation_space()
        self.action_space = spaces.Discrete(len(game.actions))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observed, dict[str, Any]]:
        """Begins the next episode, or the first one of another seed."""
        super().reset(seed=seed)
        self.world.begin(seed)
        return self.world.observation(0), self.world.info(0)

    def step(self, action: int) -> tuple[Observed, float, bool, bool, dict[str, Any]]:
        """One turn; `info` tells harvest, in_play, fired and tagged."""
        world = self.world
        world.play([int(action)])
        return world.observation(0), world.reward(0), world.terminated, world.truncated, world.info(0)

    def render(self) -> Bytes | None:
        """A picture, uint8 [rows, columns, 3]; None where it went to a window."""
        return self.world.render()

    def close(self) -> None:
        """Closes the window, if there is one."""
        self.world.close()


def register() -> None:
    """Makes the boards known to `gymnasium.make`; once is enough."""
    gymnasium.register("cprl/Commons-v0", entry_point=f"{__name__}:{CommonsGymnasiumEnv.__name__}")
    for name, board in (("SingleBasic", "single_basic"), ("SingleComplex", "single_complex")):
        gymnasium.register(
            f"cprl/{name}-v0", entry_point="cprl.presets:gymnasium_env", kwargs={"board": board}
        )
