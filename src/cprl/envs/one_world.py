"""OneWorld: one world of a game in numpy, shared by the adapters for PettingZoo and Gymnasium."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from cprl import arguments
from cprl.commons.batch import Batch, Output, turn_of
from cprl.commons.game import Game
from cprl.commons.picture import world_image
from cprl.commons.world import Bytes, GovernedOutput
from cprl.envs.drivers import drawn_seed
from cprl.institutions.memory import Payments

RENDER_MODES: Final = ("rgb_array",)
RENDER_FPS: Final = 15

Observed = NDArray[Any] | dict[str, NDArray[Any]]


class OneWorld:
    """One world of a game.

    Args:
        game: The game.
        seed: The seed of all random numbers, 0 to 2**64 - 1; None for one drawn by `drawn_seed`.
        render_mode: One of `RENDER_MODES`, or None.

    Raises:
        ValueError: If the seed or the render mode is not allowed.
    """

    def __init__(self, game: Game, *, seed: int | None, render_mode: str | None) -> None:
        if render_mode is not None and not (isinstance(render_mode, str) and render_mode in RENDER_MODES):
            raise arguments.refusal("render_mode", render_mode, f"None, {', '.join(RENDER_MODES)}")
        self.game = game
        self.batch = Batch(game, 1, seed=drawn_seed() if seed is None else seed)
        self._show_in(self.batch.new_output())
        self._decisions = np.zeros((1, game.agents), np.int64)
        self.render_mode = render_mode
        self._names = game.agent_names
        self._has_begun = False

    def _show_in(self, output: Output) -> None:
        self._whole = output
        self.output = turn_of(output)

    @property
    def payments(self) -> Payments | None:
        """What institutions output in the last turn; None for a game without any."""
        return self._whole.payments if isinstance(self._whole, GovernedOutput) else None

    def observation_space(self) -> spaces.Space[Any]:
        """A Box of uint8 [C, X, Y]; with a scoreboard or stock gauge, a Dict with it as "observation"."""
        game = self.game
        seen = spaces.Box(0, game.observation_highest, game.observation_shape, np.uint8)
        vectors: dict[str, spaces.Space[Any]] = {}
        if game.observation.scoreboard:
            vectors["scoreboard"] = spaces.Box(0, game.rules.episode_steps, (game.agents,), np.float32)
        if game.observation.stock_gauge:
            vectors["stock_gauge"] = spaces.Box(0, 1, (1,), np.float32)
        return spaces.Dict({"observation": seen, **vectors}) if vectors else seen

    def begin(self, seed: int | None, decisions: Mapping[str, Any] | None = None) -> None:
        """Begins the next episode, or the first episode of a new seed.

        Args:
            seed: The new seed, or None.
            decisions: What agents decide in this episode, by name, see `Game.decisions`; an agent that is not
                named takes the first option.

        Raises:
            ValueError: For decisions of agents or options that the game lacks; the world is unchanged.
        """
        decided = self._checked(decisions or {})
        if seed is not None:
            self.batch.set_seed(seed)
        self._decisions = decided
        self._show_in(self.batch.begin(self.batch.new_output()))
        self._has_begun = True

    def _checked(self, decisions: Any) -> NDArray[np.int64]:
        """Decisions by name as int64 [1, N]."""
        arguments.object_of("decisions", decisions, Mapping, "a dict of decisions by the names of agents")
        options, decided = self.game.decisions, np.zeros((1, self.game.agents), np.int64)
        if decisions and not options:
            raise arguments.refusal("decisions", decisions, "None: agents decide nothing in this game")
        for name, decision in decisions.items():
            arguments.choice("the agent of a decision", name, self._names)
            agent = self._names.index(name)
            decided[0, agent] = arguments.integer(f"the decision of {name}", decision, 0, options - 1)
        return decided

    def play(self, actions: Sequence[Any]) -> None:
        """Plays one turn with one action per agent.

        Raises:
            ValueError: If there is not one action per agent, one is no integer or out of range, or the
                episode has not begun; the world is unchanged.
        """
        self.check_begun("the first step")
        last = len(self.game.actions) - 1
        row = [
            arguments.integer(f"the action of {name}", action, 0, last)
            for name, action in zip(self._names, actions, strict=True)
        ]
        output, decisions = self.batch.new_output(), self._decisions if self.game.decisions else None
        self._show_in(self.batch.play_checked(np.array([row], np.int64), output, decisions))

    def observation(self, agent: int) -> Observed:
        """The observation of an agent, an element of `observation_space`."""
        output, form = self.output, self.game.observation
        vectors: dict[str, NDArray[Any]] = {}
        if form.scoreboard:
            vectors["scoreboard"] = output.scoreboard[0, agent]
        if form.stock_gauge:
            vectors["stock_gauge"] = output.stock_gauge[0, agent]
        seen = output.observation[0, agent]
        return {"observation": seen, **vectors} if vectors else seen

    def reward(self, agent: int) -> float:
        """The reward of an agent in the last turn: its harvest, less fines and plus transfers."""
        payments = self.payments
        return float((self.output.harvest if payments is None else payments.reward)[0, agent])

    def info(self, agent: int) -> dict[str, Any]:
        """An agent's harvest in the last turn, whether it fired and was tagged, and whether it acts next;
        with institutions also its "fines" and "transfers" and whether it "violated" a rule."""
        output, payments = self.output, self.payments
        paid = {} if payments is None else _paid(payments, agent)
        return {
            **paid,
            "harvest": float(output.harvest[0, agent]),
            "in_play": bool(output.in_play[0, agent]),
            "fired": bool(output.fired[0, agent]),
            "tagged": bool(output.tagged_by[0, agent].any()),
        }

    @property
    def terminated(self) -> bool:
        """Whether no apple is left and none can grow."""
        return bool(self.output.terminated[0, 0])

    @property
    def truncated(self) -> bool:
        """Whether the episode ran out of time."""
        return bool(self.output.truncated[0, 0])

    def check_begun(self, what: str) -> None:
        """Raise a ValueError where no episode has begun; `what` would be done in it."""
        if not self._has_begun:
            raise ValueError(f"the episode has not begun; allowed: reset() before {what}")

    def state(self) -> Bytes:
        """The whole board in RGB: uint8 [3, H, W].

        Raises:
            ValueError: If the episode has not begun.
        """
        self.check_begun("state()")
        board = self.game.palette[self.batch.boards(self.output)[0]]
        return np.ascontiguousarray(board.transpose(2, 0, 1))

    def render(self) -> Bytes:
        """Return an image, uint8 [rows, columns, 3].

        Raises:
            ValueError: If there is no render mode, or the episode has not begun.
        """
        if self.render_mode is None:
            raise ValueError(
                'render_mode is None, so render() is unavailable; allowed: "rgb_array", chosen when the '
                "environment is made"
            )
        self.check_begun("render()")
        return world_image(self.game.map, self.batch.show(self.output))


def _paid(payments: Payments, agent: int) -> dict[str, Any]:
    """What institutions did to an agent in the last turn."""
    return {
        "fines": float(payments.fines[0, agent]),
        "transfers": float(payments.transfers[0, agent]),
        "violated": bool(payments.violated[0, agent]),
    }
