"""A governor in a training: it decides, and learns from periods of many turns, at its own clock."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from cprl import keys
from cprl.commons.game import Game
from cprl.keys import Turn
from cprl.learners.lanes import Lanes
from cprl.learners.learner import Learner
from cprl.measuring.social import incomes_of
from cprl.measuring.welfare import welfare
from cprl.policies.actors import LaneActor
from cprl.policies.governors import GovernorActor
from cprl.policies.rng import Purpose
from cprl.population import GovernorSpec, Learning
from cprl.training.stored import StoredAgent, stored_governor
from cprl.values import instantiate
from cprl.values.array_types import AnyArray

_AT_THE_LAST: Final = (keys.SEEN, keys.STOCK, keys.DONE, keys.TERMINATED)
"""The entries of worlds that are kept of a period: "seen" [B, S]; "stock", "done" and "terminated" [B, 1]."""


class Governing:
    """A governor of R replicas of W worlds, which learns from one transition of each world and period.

    A transition is what the governor saw when it decided, its option, its reward, and what it saw at the end
    of the period, or at the end of the first episode that ended in it: later turns of the period count for
    nothing. The reward is `cprl.measuring.welfare` of the turns that count. Settings of its algorithm count
    periods where they count steps of agents.

    Args:
        game: the game with the governor.
        spec: how it decides.
        lanes: the governor as the agent after the last one, see `governor_spaces`.
        stored: the governor of each replica; () if it learns.
        from_turn: the turns before its first decision.
    """

    def __init__(
        self,
        game: Game,
        spec: GovernorSpec,
        lanes: Lanes,
        *,
        stored: Sequence[StoredAgent] = (),
        from_turn: int = 0,
    ) -> None:
        assert game.governor is not None
        self._game = game
        self._governor = game.governor
        self._lanes = lanes
        self._stored = stored
        self.learner: Learner | None = None
        """Learns, as the agent after the last one; None for a governor that does not learn."""
        if isinstance(spec, Learning):
            self.learner = instantiate(spec.algorithm).make_learner(lanes, "eager")
            self.actor = GovernorActor(self._governor, self.learner.actor)
        else:
            self.actor = self._stored_actor(Purpose.EXPLORATION, lanes.worlds)
        self.actor.from_turn = from_turn
        self._period: dict[str, AnyArray] = {}
        """Of the turns of this period that count, by name: "income" [B, N] and "steps" [B], their sums;
        `_AT_THE_LAST`, as it is after the last of them. Empty before the first."""
        self._loss = torch.full((lanes.replicas, 1), float("nan"))
        """The loss of the last update of each replica, [R, 1]; NaN before the first."""

    def store(self, turn: Turn) -> None:
        """Count a turn, and learn at the end of a period, if the governor learns."""
        if self.learner is None or self.actor.seen is None:
            return
        now = {name: _copied(turn.next_world[name]) for name in _AT_THE_LAST}
        paid = [_copied(turn.next_agents[key[-1]]) for key in (keys.HARVEST, keys.FINES, keys.TRANSFERS)]
        now["income"] = incomes_of(*paid)
        now["steps"] = np.ones(len(now["income"]), np.int64)
        if self._period:
            for name in ("income", "steps"):
                now[name] += self._period[name]
            ended = self._period[keys.DONE][:, 0]
            for name, entry in now.items():
                entry[ended] = self._period[name][ended]
        self._period = now
        if self.actor.turns % self._governor.every_steps == 0:
            self._learn(self.learner)
            self._period = {}

    def _learn(self, learner: Learner) -> None:
        """Learn from the period that has ended."""
        batch = self._transitions()
        learner.store(batch)
        loss = learner.update()
        learner.end_episode(batch["next", keys.DONE][:, 0])
        if loss is not None:
            self._loss = loss.cpu()

    def _transitions(self) -> TensorDict:
        """Return the period as a turn of agents of which the last is the governor."""
        assert self.actor.seen is not None
        assert self.actor.rule is not None
        period = self._period
        reward = welfare(self._game, period["income"], period["steps"], period[keys.STOCK][:, 0])
        entries = {
            keys.OBSERVATION: self._as_last(self.actor.seen),
            keys.ACTION: self._as_last(self.actor.rule),
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

    @property
    def learners(self) -> dict[tuple[int, ...], Learner]:
        """Return its learner by the agent after the last one; {} if it does not learn."""
        return {} if self.learner is None else {self.learner.agents: self.learner}

    def evaluation_actor(self, worlds: int) -> GovernorActor:
        """Return an actor of the current governor for several worlds of each replica."""
        if self.learner is None:
            return self._stored_actor(Purpose.EVALUATION, worlds)
        return GovernorActor(self._governor, self.learner.evaluation_actor(worlds))

    def random_actor(self, worlds: int) -> GovernorActor:
        """Return an actor that decides at random, for several worlds of each replica."""
        options = len(self._governor.options)
        seeds = self._lanes.agent_seeds(Purpose.RANDOM_PLAY)
        return GovernorActor(self._governor, LaneActor(None, options, seeds=seeds, agents=1, worlds=worlds))

    def _stored_actor(self, purpose: Purpose, worlds: int) -> GovernorActor:
        """Return the actor of a governor that does not learn, with random numbers for a purpose."""
        seeds = self._lanes.agent_seeds(purpose)
        return stored_governor(self._game, self._stored, seeds=seeds, worlds=worlds)

    def state_dict(self) -> dict[str, Any]:
        return {
            "actor": self.actor.state_dict(),
            "learner": None if self.learner is None else self.learner.state_dict(),
            "period": {name: torch.tensor(array) for name, array in self._period.items()},
            "loss": self._loss,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.actor.load_state_dict(state["actor"])
        if self.learner is not None:
            self.learner.load_state_dict(state["learner"])
        self._period = {name: tensor.numpy().copy() for name, tensor in state["period"].items()}
        self._loss = state["loss"].clone()


def _copied(entry: Any) -> AnyArray:
    """Return a copy of an entry of a turn, as a numpy array."""
    return torch.as_tensor(entry).clone().numpy(force=True)
