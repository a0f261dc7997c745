"""Adapters for PettingZoo: agents act all at once (`parallel_env`) or one after the other (`env`)."""

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
from cprl.values import Range, checked, refusal, short_repr
from cprl.values.array_types import Int64, UInt8

RENDER_MODES: Final = ("rgb_array",)
RENDER_FPS: Final = 15

Infos = dict[str, dict[str, Any]]
"""The further results of a turn, by the name of the agent and then by the name of the result."""


class CommonsParallelEnv(ParallelEnv[str, Any, int]):
    """One world of a game as a PettingZoo `ParallelEnv`; the agents are agent_0, agent_1, and so on.

    Every agent acts in every turn until the episode ends for all of them. The action of an agent that is out
    of play has no effect.

    `infos` holds for each agent its "harvest", whether it acts in the coming turn ("in_play"), whether it
    "fired" and whether it was "tagged". With institutions it also holds the agent's "fines" and "transfers",
    and whether it "violated" a rule.

    Args:
        seed: the seed of all random numbers; `reset(seed=...)` restarts with another one. None draws a seed
            from torch's generator, a different one for each environment, as `CommonsEnv` does.
        render_mode: "rgb_array", or None for an environment that is never rendered.
    """

    metadata: ClassVar[dict[str, Any]] = {
        "name": "commons_v0",
        "render_modes": list(RENDER_MODES),
        "render_fps": RENDER_FPS,
        "is_parallelizable": True,
    }

    def __init__(self, game: Game, *, seed: int | None = None, render_mode: str | None = None) -> None:
        checked("render_mode", render_mode, Literal[RENDER_MODES] | None)
        self.game = game
        self.render_mode = render_mode
        seed = drawn_seed() if seed is None else seed
        self.batch = Batch(game, 1, seed=seed)
        self.output = self.batch.new_output()
        """The output of the last turn."""
        self._decisions = np.zeros((1, game.agents), np.int64)
        self.possible_agents = list(game.agent_names)
        self.agents: list[str] = []
        highest = game.observation_highest
        self.observation_spaces = {
            name: spaces.Box(0, highest, game.observation_shape, np.uint8) for name in self.possible_agents
        }
        self.action_spaces = {name: spaces.Discrete(len(game.actions)) for name in self.possible_agents}
        self.state_space = spaces.Box(0, 255, (3, game.map.height, game.map.width), np.uint8)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.game!r})"

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """Return the space of an agent's observations, a Box of uint8 [C, X, Y]: always the same object."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """Return the space of an agent's actions, the indices of `Game.actions`: always the same object."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, UInt8], Infos]:
        """Begin the next episode, or the first episode of a new seed.

        Args:
            seed: the seed to restart from; None goes on with the current one.
            options: its entry "decisions", a dict by agent, holds what agents decide in this episode where
                institutions ask them: an integer below `Game.decisions`, 0 by default. Other entries are
                ignored.
        """
        decisions = self._read_decisions((options or {}).get("decisions") or {})
        if seed is not None:
            self.batch.set_seed(seed)
        self._decisions = decisions
        self.output = self.batch.begin()
        self.agents = list(self.possible_agents)
        return self._observations(), self._infos()

    def _read_decisions(self, decisions_by_name: Any) -> Int64:
        """Return decisions by agent's name as int64 [1, N]; an agent without one takes its first option."""
        option_count = self.game.decisions
        decisions = np.zeros((1, self.game.agents), np.int64)
        if decisions_by_name and not option_count:
            raise refusal("decisions", decisions_by_name, "None: agents decide nothing in this game")
        for name, decision in decisions_by_name.items():
            if name not in self.possible_agents:
                raise refusal("the agent of a decision", name, ", ".join(self.possible_agents))
            agent = self.possible_agents.index(name)
            allowed_type = Annotated[int, Range(0, option_count - 1)]
            decisions[0, agent] = checked(f"the decision of {name}", decision, allowed_type)
        return decisions

    def step(
        self, actions: dict[str, int]
    ) -> tuple[dict[str, UInt8], dict[str, float], dict[str, bool], dict[str, bool], Infos]:
        """Play one turn with one action per agent.

        Returns:
            Observations, rewards, terminations, truncations and infos, each a dict by agent.

        Raises:
            ValueError: for unknown actions, and before or after an episode; the world is then unchanged.
        """
        self._check_begun("the first step")
        if not self.agents:
            raise ValueError("the episode has ended; allowed: reset() before the next step")
        if set(actions) != set(self.agents):
            raise ValueError(
                f"actions has the agents {short_repr(list(actions))}; allowed: exactly {self.agents}"
            )
        self.play([actions[name] for name in self.agents])
        rewards = {name: self.reward(agent) for agent, name in enumerate(self.agents)}
        terminations = dict.fromkeys(self.agents, self.terminated)
        truncations = dict.fromkeys(self.agents, self.truncated)
        result = self._observations(), rewards, terminations, truncations, self._infos()
        if self.terminated or self.truncated:
            self.agents = []  # PettingZoo's sign that the episode has ended for all
        return result

    def play(self, actions: Sequence[Any]) -> None:
        """Play one turn with one action per agent, in the order of their indices, and keep its output.

        A world whose episode has ended does not change. Errors are those of `step`.
        """
        self._check_begun("the first step")
        allowed_type = Annotated[int, Range(0, len(self.game.actions) - 1)]
        checked_actions = [
            checked(f"the action of {name}", action, allowed_type)
            for name, action in zip(self.possible_agents, actions, strict=True)
        ]
        decisions = self._decisions if self.game.decisions else None
        action_row = np.array([checked_actions], np.int64)
        self.output = self.batch.play(action_row, self.batch.new_output(), decisions)

    def observation(self, agent: int) -> UInt8:
        """Return the observation of an agent, an element of its `observation_space`."""
        observation: UInt8 = self.output.observation[0, agent]
        return observation

    def reward(self, agent: int) -> float:
        """Return the reward of an agent in the last turn: its harvest, minus fines, plus transfers."""
        return float(self.output.reward[0, agent])

    def info(self, agent: int) -> dict[str, Any]:
        """Return the entries of an agent in `infos` after the last turn."""
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
        """Return whether the episode ended because no apple is left and none can grow."""
        return bool(self.output.terminated[0, 0])

    @property
    def truncated(self) -> bool:
        """Return whether the episode ended because it ran out of time."""
        return bool(self.output.truncated[0, 0])

    def _check_begun(self, call: str) -> None:
        """Raise a ValueError if no episode has begun; `call` names what was called, for the message."""
        if not self.batch.has_begun:
            raise ValueError(f"the episode has not begun; allowed: reset() before {call}")

    def state(self) -> UInt8:
        """Return the whole board as colours in RGB, one pixel per cell: uint8 [3, H, W]."""
        self._check_begun("state()")
        board = self.game.palette[self.batch.boards()[0]]
        return np.ascontiguousarray(board.transpose(2, 0, 1))

    def render(self) -> UInt8:
        """Return an image of the board for people, uint8 [rows, columns, 3]."""
        if self.render_mode is None:
            raise ValueError('render_mode is None, so there is no render(); allowed: "rgb_array", when made')
        self._check_begun("render()")
        return world_image(self.game.map, self.batch.show(self.output))

    def _observations(self) -> dict[str, UInt8]:
        return {name: self.observation(agent) for agent, name in enumerate(self.agents)}

    def _infos(self) -> Infos:
        return {name: self.info(agent) for agent, name in enumerate(self.agents)}


def parallel_env(
    game: Game, seed: int | None = None, *, render_mode: str | None = None
) -> CommonsParallelEnv:
    """Return the game as a PettingZoo `ParallelEnv`; see `CommonsParallelEnv`."""
    return CommonsParallelEnv(game, seed=seed, render_mode=render_mode)


def env(game: Game, seed: int | None = None, *, render_mode: str | None = None) -> AECEnv[str, Any, int]:
    """Return the game as a PettingZoo `AECEnv`: agents act one by one, and the turn is played once the last
    agent has acted."""
    return parallel_to_aec(parallel_env(game, seed, render_mode=render_mode))
