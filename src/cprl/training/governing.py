"""A governor in a training: it decides, and learns from periods of many turns, at its own clock."""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from cprl import keys
from cprl.commons.game import Game
from cprl.keys import Turn
from cprl.learners.learner import Learner
from cprl.measuring.social import incomes_of
from cprl.measuring.welfare import welfare
from cprl.policies.governors import GovernorActor
from cprl.values.array_types import AnyArray

_COUNTED: Final = (
    *(keys.SEEN, keys.STOCK, keys.DONE, keys.TERMINATED),
    *(keys.HARVEST, keys.FINES, keys.TRANSFERS),
)
"""The entries of a turn that a period is counted from."""


class Governing:
    """A governor of R replicas of W worlds, which learns from one transition of each world and period.

    A transition is what the governor saw when it decided, its option, its reward, and what it saw at the end
    of the period, or at the end of the first episode that ended in it: later turns of the period count for
    nothing. The reward is `cprl.measuring.welfare` of the turns that count. Settings of its algorithm count
    periods where they count steps of agents.

    Args:
        game: the game with the governor.
        actor: decides in the training.
        learner: learns, as the agent after the last one; None for a governor that does not learn.
    """

    def __init__(self, game: Game, actor: GovernorActor, learner: Learner | None) -> None:
        self._game = game
        self.actor = actor
        self.learner = learner
        self._period: dict[str, AnyArray] = {}
        """Of the turns of this period that count, by name: "income" [B, N] and "steps" [B, 1], their sums;
        "seen" [B, S], "stock", "done" and "terminated" [B, 1], as they are after the last of them. Empty
        before the first."""
        self._loss = torch.full((0 if learner is None else learner.replicas, 1), float("nan"))
        """The loss of the last update of each replica, [R, 1]; NaN before the first."""

    def store(self, turn: Turn) -> None:
        """Count a turn, and learn at the end of a period, if the governor learns."""
        if self.learner is None or self.actor.last_features is None:
            return
        before = self._period
        now = turn.batch["next"].select(*_COUNTED).cpu().numpy()
        now["income"] = incomes_of(**now.pop(keys.AGENTS))
        now["steps"] = np.ones_like(now[keys.STOCK])
        if before:
            now["income"] += before["income"]
            now["steps"] += before["steps"]
            now = {name: np.where(before[keys.DONE], before[name], entry) for name, entry in now.items()}
        self._period = now
        if self.actor.is_due:
            self.learner.store(self._transitions())
            loss = self.learner.update()
            self.learner.end_episode(torch.from_numpy(now[keys.DONE][:, 0]))
            if loss is not None:
                self._loss = loss.cpu()
            self._period = {}

    def _transitions(self) -> TensorDict:
        """Return the period as a turn of agents of which the last is the governor."""
        assert self.actor.last_features is not None
        assert self.actor.options_in_force is not None
        period = self._period
        reward = welfare(self._game, period["income"], period["steps"][:, 0], period[keys.STOCK][:, 0])
        entries = {
            keys.OBSERVATION: self._as_last(self.actor.last_features),
            keys.ACTION: self._as_last(self.actor.options_in_force),
            ("next", *keys.OBSERVATION): self._as_last(torch.from_numpy(period[keys.SEEN])),
            ("next", *keys.REWARD): self._as_last(torch.tensor(reward, dtype=torch.float32)[:, None]),
            ("next", keys.DONE): torch.from_numpy(period[keys.DONE]),
            ("next", keys.TERMINATED): torch.from_numpy(period[keys.TERMINATED]),
        }
        return TensorDict(entries, [len(reward)])

    def _as_last(self, entry: Tensor) -> Tensor:
        """Return an entry of worlds, [B, ...], as that of N + 1 agents, [B, N + 1, ...]."""
        return entry[:, None].expand(-1, self._game.agents + 1, *entry.shape[1:])

    def numbers(self, replica: int) -> dict[str, float]:
        """Return what is logged beside an episode of a replica: how its governor learns."""
        if self.learner is None:
            return {}
        return {
            "governor/loss": float(self._loss[replica]),
            "governor/epsilon": self.learner.actor.epsilon,
        }

    def state_dict(self) -> dict[str, Any]:
        return {
            "actor": self.actor.state_dict(),
            "learner": None if self.learner is None else self.learner.state_dict(),
            "period": {name: torch.from_numpy(array) for name, array in self._period.items()},
            "loss": self._loss,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.actor.load_state_dict(state["actor"])
        if self.learner is not None:
            self.learner.load_state_dict(state["learner"])
        self._period = {name: entry.numpy() for name, entry in state["period"].items()}
        self._loss = state["loss"]
