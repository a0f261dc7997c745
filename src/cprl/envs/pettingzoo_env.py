"""Adapters for PettingZoo: all agents at once (`parallel_env`), or one after the other (`env`)."""

from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, Final, Literal

import numpy as np
from gymnasium import spaces
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils import parallel_to_aec

from cprl import keys
from cprl.commons.batch import Batch
from cprl.commons.game import Game
from cprl.envs.drivers import drawn_seed
from cprl.pictures.image import world_image
from cprl.values import Range, checked, refusal, shown
from cprl.values.arrays import Int64, UInt8

RENDER_MODES: Final = ("rgb_array",)
RENDER_FPS: Final = 15

Infos = dict[str, dict[str, Any]]


class CommonsParallelEnv(ParallelEnv[str, Any, int]):
    """One world of a game as a PettingZoo `ParallelEnv`; agents are agent_0, agent_1, ...

    Every agent acts in every turn until the episode ends for all; the action of an agent out of play has no
    effect. `infos` holds each agent's "harvest", whether it acts in the coming turn ("in_play"), whether it
    "fired" and whether it was "tagged"; with institutions also its "fines", "transfers" and whether it
    "violated" a rule.

    Args:
        seed: of all random numbers; `reset(seed=...)` restarts with another one. None draws one from torch's
            generator, another for each environment, as `CommonsEnv` does.
    """

    metadata: ClassVar[dict[str, Any]] = {
        "name": "commons_v0",
        "render_modes": list(RENDER_MODES),
        "render_fps": RENDER_FPS,
        "is_parallelizable": True,
    }

    def __init__(self, game: Game, *, seed: int | None = None, render_mode: str | None = None) -> None:
        checked("render_mode", render_mode, Literal[RENDER_MODES] | None)
        self.game, self.render_mode = game, render_mode
        self.batch = Batch(game, 1, seed=drawn_seed() if seed is None else seed)
        self.output = self.batch.new_output()
        """What the last turn gave."""
        self._decisions = np.zeros((1, game.agents), np.int64)
        self.possible_agents = list(game.agent_names)
        self.agents: list[str] = []
        self.observation_spaces = {name: self._observation_space() for name in self.possible_agents}
        self.action_spaces = {name: spaces.Discrete(len(game.actions)) for name in self.possible_agents}
        self.state_space = spaces.Box(0, 255, (3, game.map.height, game.map.width), np.uint8)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.game!r})"

    def _observation_space(self) -> spaces.Space[Any]:
        return spaces.Box(0, self.game.observation_highest, self.game.observation_shape, np.uint8)

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """Return a Box of uint8 [C, X, Y], always the same object."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """Return a Discrete space, the indices of `Game.actions`; always the same object."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, UInt8], Infos]:
        """Begin the next episode, or the first episode of a new seed.

        Args:
            options: "decisions", a dict by agent, is what agents decide in this episode where institutions
                ask them (`Game.decisions` options, the first one by default); others are ignored.
        """
        decided = self._decided((options or {}).get("decisions") or {})
        if seed is not None:
            self.batch.set_seed(seed)
        self._decisions = decided
        self.output = self.batch.begin(self.batch.new_output())
        self.agents = list(self.possible_agents)
        return self._observations(), self._infos()

    def _decided(self, decisions: Any) -> Int64:
        """Decisions by name as int64 [1, N]; the first option of an agent that is not named."""
        options, decided = self.game.decisions, np.zeros((1, self.game.agents), np.int64)
        if decisions and not options:
            raise refusal("decisions", decisions, "None: agents decide nothing in this game")
        for name, decision in decisions.items():
            if name not in self.possible_agents:
                raise refusal("the agent of a decision", name, ", ".join(self.possible_agents))
            agent = self.possible_agents.index(name)
            hint = Annotated[int, Range(0, options - 1)]
            decided[0, agent] = checked(f"the decision of {name}", decision, hint)
        return decided

    def step(
        self, actions: dict[str, int]
    ) -> tuple[dict[str, UInt8], dict[str, float], dict[str, bool], dict[str, bool], Infos]:
        """Play one turn with one action per agent; actions that do not fit, and steps before or after an
        episode, raise a ValueError and leave the world unchanged."""
        self._check_begun("the first step")
        if not self.agents:
            raise ValueError("the episode has ended; allowed: reset() before the next step")
        if set(actions) != set(self.agents):
            raise ValueError(f"actions has the agents {shown(list(actions))}; allowed: exactly {self.agents}")
        self.play([actions[name] for name in self.agents])
        rewards = {name: self.reward(i) for i, name in enumerate(self.agents)}
        terminations = dict.fromkeys(self.agents, self.terminated)
        truncations = dict.fromkeys(self.agents, self.truncated)
        output = self._observations(), rewards, terminations, truncations, self._infos()
        if self.terminated or self.truncated:
            self.agents = []
        return output

    def play(self, actions: Sequence[Any]) -> None:
        """Play one turn with one action per agent, in their order; see `step`. An ended world stays as it
        is."""
        self._check_begun("the first step")
        known = Annotated[int, Range(0, len(self.game.actions) - 1)]
        row = [
            checked(f"the action of {name}", action, known)
            for name, action in zip(self.possible_agents, actions, strict=True)
        ]
        output, decisions = self.batch.new_output(), self._decisions if self.game.decisions else None
        self.output = self.batch.play(np.array([row], np.int64), output, decisions)

    def observation(self, agent: int) -> UInt8:
        """Return the observation of an agent, an element of its `observation_space`."""
        seen: UInt8 = self.output.observation[0, agent]
        return seen

    def reward(self, agent: int) -> float:
        """Return the reward of an agent in the last turn: its harvest, less fines and plus transfers."""
        return float(self.output.reward[0, agent])

    def info(self, agent: int) -> dict[str, Any]:
        """Return what `infos` holds of an agent after the last turn."""
        output = self.output
        info: dict[str, Any] = {
            "harvest": float(output.harvest[0, agent]),
            "in_play": bool(output.in_play[0, agent]),
            "fired": bool(output.fired[0, agent]),
            "tagged": bool(output.tagged_by[0, agent].any()),
        }
        if self.game.institutions:
            info[keys.FINES[-1]] = float(output.fines[0, agent])
            info[keys.TRANSFERS[-1]] = float(output.transfers[0, agent])
            info[keys.VIOLATED[-1]] = bool(output.violated[0, agent])
        return info

    @property
    def terminated(self) -> bool:
        """Whether no apple is left and none can grow."""
        return bool(self.output.terminated[0, 0])

    @property
    def truncated(self) -> bool:
        """Whether the episode ran out of time."""
        return bool(self.output.truncated[0, 0])

    def _check_begun(self, what: str) -> None:
        """Raise a ValueError where no episode has begun; `what` would be done in it."""
        if not self.batch.has_begun:
            raise ValueError(f"the episode has not begun; allowed: reset() before {what}")

    def state(self) -> UInt8:
        """Return the whole board in RGB: uint8 [3, H, W]."""
        self._check_begun("state()")
        board = self.game.palette[self.batch.boards(self.output)[0]]
        return np.ascontiguousarray(board.transpose(2, 0, 1))

    def render(self) -> UInt8:
        """Return an image, uint8 [rows, columns, 3]."""
        if self.render_mode is None:
            raise ValueError('render_mode is None, so there is no render(); allowed: "rgb_array", when made')
        self._check_begun("render()")
        return world_image(self.game.map, self.batch.show(self.output))

    def _observations(self) -> dict[str, UInt8]:
        return {name: self.observation(i) for i, name in enumerate(self.agents)}

    def _infos(self) -> Infos:
        return {name: self.info(i) for i, name in enumerate(self.agents)}


def parallel_env(
    game: Game, seed: int | None = None, *, render_mode: str | None = None
) -> CommonsParallelEnv:
    """Return the game as a PettingZoo `ParallelEnv`; see `CommonsParallelEnv`."""
    return CommonsParallelEnv(game, seed=seed, render_mode=render_mode)


def env(game: Game, seed: int | None = None, *, render_mode: str | None = None) -> AECEnv[str, Any, int]:
    """Return the game as a PettingZoo `AECEnv`: agents act one by one; a turn is played after the last has
    acted."""
    return parallel_to_aec(parallel_env(game, seed, render_mode=render_mode))
