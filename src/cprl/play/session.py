"""Session: an episode in which a person decides for one agent; without any input or output."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from cprl import arguments, keys
from cprl.commons.game import Game
from cprl.commons.world import Shown
from cprl.envs.unwrap import commons_of
from cprl.evaluation.turns import Policy, Turns
from cprl.measuring import social


@dataclass(frozen=True, kw_only=True, eq=False)
class TurnPlayed:
    """What one turn brought."""

    harvest: NDArray[np.float32]
    """float32 [N], apples that each agent harvested in this turn."""
    fired: NDArray[np.bool_]
    """bool [N], who fired."""
    tagged_by: NDArray[np.bool_]
    """bool [N, N]; row: the agent tagged out, column: by whom."""


class Session:
    """The episode, turn by turn.

    Args:
        env: one world of a `CommonsEnv`, with or without transforms; it is reset.
        others: writes the actions of all agents; that of the person's agent is replaced.
        agent: the index of the person's agent.
        decision: what it decides, see `Game.decisions`; None for what `others` write.

    Raises:
        ValueError: if the environment is of another kind, or has no such agent or decision.
    """

    def __init__(self, env: EnvBase, others: Policy, *, agent: int = 0, decision: int | None = None) -> None:
        commons = commons_of(env)
        if commons is None:
            raise ValueError(f"env is a {type(env).__name__}; allowed: a CommonsEnv, which has a board")
        self._commons, self._others = commons, others
        self.game: Game = commons.game
        self.agent = arguments.integer("agent", agent, 0, self.game.agents - 1)
        """The index of the person's agent."""
        self._decision = None if decision is None else self._decided(decision)
        self._action = 0
        self._turns = Turns(env, self._choose)
        self._harvests: list[Tensor] = []
        self._in_play: list[Tensor] = []
        self.moments: list[Shown] = [self._now()]
        """The board as the episode began, then after each turn."""

    @property
    def turn(self) -> int:
        """Turns played."""
        return len(self.moments) - 1

    @property
    def has_ended(self) -> bool:
        """Whether the episode has ended: no apple is left and none can grow, or time is over."""
        return self._turns.has_ended

    @property
    def is_in_play(self) -> bool:
        """Whether the person's next action will count: a tagged agent is out of play for some turns."""
        return bool(self.moments[-1].in_play[self.agent])

    @property
    def harvested(self) -> list[int]:
        """Apples that each agent has harvested so far."""
        return [int(apples) for apples in self.moments[-1].harvested]

    @property
    def stock(self) -> int:
        """Apples on the board."""
        return int(self.moments[-1].stock.sum(dtype=np.int64))

    def act(self, action: str) -> TurnPlayed:
        """Plays a turn: the person's agent takes this action, the others choose theirs.

        Raises:
            ValueError: if the game has no action of this name, or the episode has ended; nothing is played.
        """
        arguments.choice("action", action, self.game.actions)
        self._action = self.game.actions.index(action)
        batch = self._turns.play()
        following = batch["next"]
        self._harvests.append(following[keys.HARVEST])
        self._in_play.append(batch[keys.IN_PLAY])
        self.moments.append(self._now())
        output = self._commons.output
        return TurnPlayed(
            harvest=output.harvest[0].copy(),
            fired=output.fired[0].copy(),
            tagged_by=output.tagged_by[0].copy(),
        )

    def metrics(self) -> dict[str, float]:
        """The social metrics of the turns played so far, those of `cprl.measuring.social.summary` and
        stock_left; NaN where undefined, empty before the first turn."""
        if not self._harvests:
            return {}
        measured = social.summary(torch.cat(self._harvests), torch.cat(self._in_play))
        return {**{name: float(value) for name, value in measured.items()}, "stock_left": float(self.stock)}

    def _choose(self, moment: TensorDictBase) -> TensorDictBase:
        chosen = self._others(moment)
        actions = chosen[keys.ACTION].clone()
        actions[0, self.agent] = self._action
        chosen[keys.ACTION] = actions
        if self._decision is not None:
            decisions = chosen[keys.DECISION].clone()
            decisions[0, self.agent] = self._decision
            chosen[keys.DECISION] = decisions
        return chosen

    def _decided(self, decision: int) -> int:
        options = self.game.decisions
        if not options:
            raise arguments.refusal("decision", decision, "None: agents decide nothing in this game")
        return arguments.integer("decision", decision, 0, options - 1)

    def _now(self) -> Shown:
        """The board, without what agents observe."""
        shown = self._commons.worlds.show(self._commons.output)
        return shown._replace(observation=shown.observation[:0])
