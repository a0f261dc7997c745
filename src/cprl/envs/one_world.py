"""OneWorld: one world of a game in numpy, as the doors of PettingZoo and Gymnasium show it."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from cprl.commons.batch import Batch
from cprl.commons.game import Game
from cprl.commons.picture import world_image
from cprl.commons.world import Bytes
from cprl.envs.window import Window

RENDER_MODES: Final = ("rgb_array", "human")
RENDER_FPS: Final = 15

Observed = NDArray[Any] | dict[str, NDArray[Any]]


class OneWorld:
    """One world that begins, is played and is looked at.

    Args:
        game: what is played.
        seed: what all chance follows from.
        title: of the window of `render_mode="human"`.
        render_mode: one of `RENDER_MODES`, or None.

    Raises:
        ValueError: for another render mode.
        RuntimeError: for "human" where no window can be opened.
    """

    def __init__(self, game: Game, *, seed: int, title: str, render_mode: str | None) -> None:
        if render_mode not in (None, *RENDER_MODES):
            raise ValueError(f"render_mode is {render_mode!r}; allowed: None, {', '.join(RENDER_MODES)}")
        self.game = game
        self.batch = Batch(game, 1, seed=seed)
        self.output = self.batch.new_output()
        self.render_mode = render_mode
        self._window = Window(title) if render_mode == "human" else None

    def observation_space(self) -> spaces.Space[Any]:
        """A Box of uint8 [C, X, Y]; a Dict with it as "observation" where vectors are observed too."""
        game = self.game
        seen = spaces.Box(0, game.observation.highest, game.observation_shape, np.uint8)
        vectors: dict[str, spaces.Space[Any]] = {}
        if game.observation.scoreboard:
            vectors["scoreboard"] = spaces.Box(0, game.rules.episode_steps, (game.agents,), np.float32)
        if game.observation.stock_gauge:
            vectors["stock_gauge"] = spaces.Box(0, 1, (1,), np.float32)
        return spaces.Dict({"observation": seen, **vectors}) if vectors else seen

    def begin(self, seed: int | None) -> None:
        """The next episode, or the first one of another seed."""
        if seed is not None:
            self.batch.set_seed(seed)
        self.output = self.batch.begin(self.batch.new_output())
        if self._window:
            self.render()

    def play(self, actions: Sequence[int]) -> None:
        """One turn; an action for each agent.

        Raises:
            ValueError: for actions that the game does not know; then nothing has changed.
        """
        row = np.array([actions], np.int64)
        self.batch.check(row)
        self.output = self.batch.play_checked(row, self.batch.new_output())
        if self._window:
            self.render()

    def observation(self, agent: int) -> Observed:
        """What an agent observes, as `observation_space` says."""
        output, form = self.output, self.game.observation
        vectors: dict[str, NDArray[Any]] = {}
        if form.scoreboard:
            vectors["scoreboard"] = output.scoreboard[0, agent]
        if form.stock_gauge:
            vectors["stock_gauge"] = output.stock_gauge[0, agent]
        seen = output.observation[0, agent]
        return {"observation": seen, **vectors} if vectors else seen

    def reward(self, agent: int) -> float:
        """What an agent is paid for the turn: its harvest."""
        return float(self.output.harvest[0, agent])

    def info(self, agent: int) -> dict[str, Any]:
        """What else happened to an agent in the turn, and whether it acts in the coming one."""
        output = self.output
        return {
            "harvest": float(output.harvest[0, agent]),
            "in_play": bool(output.in_play[0, agent]),
            "fired": bool(output.fired[0, agent]),
            "tagged": bool(output.tagged_by[0, agent].any()),
        }

    @property
    def terminated(self) -> bool:
        """Whether no apple is left and none can come."""
        return bool(self.output.terminated[0, 0])

    @property
    def truncated(self) -> bool:
        """Whether the clock ran out."""
        return bool(self.output.truncated[0, 0])

    def state(self) -> Bytes:
        """uint8 [3, H, W], the whole board as RGB."""
        board = self.game.palette[self.batch.boards(self.output)[0]]
        return np.ascontiguousarray(board.transpose(2, 0, 1))

    def render(self) -> Bytes | None:
        """A picture, uint8 [rows, columns, 3], under "rgb_array"; under "human" it goes to the window.

        Raises:
            ValueError: where no render mode was chosen.
        """
        if self.render_mode is None:
            raise ValueError(
                'nothing can be rendered: make the environment with render_mode="rgb_array" or "human"'
            )
        image = world_image(self.game.map, self.batch.show(self.output))
        if self._window is None:
            return image
        self._window.show(image)
        return None

    def close(self) -> None:
        """Closes the window, if there is one."""
        if self._window:
            self._window.close()
