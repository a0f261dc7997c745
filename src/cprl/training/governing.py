"""A governor in a training: it decides, and learns from periods of many turns, at its own clock."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from cprl import keys
from cprl.commons.game import Game
from cprl.institutions import Governor
from cprl.keys import Turn
from cprl.learners.lanes import Lanes
from cprl.learners.learner import Learner
from cprl.measuring.social import incomes_of
from cprl.measuring.welfare import welfare
from cprl.policies.actors import LaneActor
from cprl.policies.governors import GovernorActor, Script
from cprl.policies.rng import Purpose, lane_name
from cprl.population import Frozen, GovernorSpec, Learning
from cprl.training.stored import StoredAgent, load, stored_governor, trained_agent
from cprl.values import instantiate
from cprl.values.array_types import AnyArray


class Governing:
    """A governor of R replicas of W worlds, which learns from one transition of each world and period.

    A transition is what the governor saw when it decided, its option, its reward, and what it saw at the end
    of the period, or at the end of the first episode that ended in it: later turns of the period count for
    nothing. The reward is `cprl.measuring.welfare` of the turns that count. Settings of its algorithm count
    periods where they count steps of agents.

    Args:
        game: the game with the governor.
        governor: the governor.
        spec: how it decides.
        lanes: the governor as the agent after the last one, see `governor_spaces`.
        from_turn: the turns before its first decision.
        weights: the names of the weights of `Frozen` agents by run, see `cprl.load`.
    """

    def __init__(
        self,
        game: Game,
        governor: Governor,
        spec: GovernorSpec,
        lanes: Lanes,
        *,
        from_turn: int = 0,
        weights: Mapping[str, str] | None = None,
    ) -> None:
        self._game = game
        self._governor = governor
        self._spec = spec
        self._lanes = lanes
        self.learner: Learner | None = None
        """Learns, as the agent after the last one; None for a governor that does not learn."""
        self._stored: list[StoredAgent] = []
        """The governor of each replica; [] if it learns."""
        if isinstance(spec, Learning):
            self.learner = instantiate(spec.algorithm).make_learner(lanes, "eager")
            self.actor = GovernorActor(governor, self.learner.actor, from_turn=from_turn)
        else:
            self._stored = self._load(spec, weights or {})
            self.actor = self._stored_actor(Purpose.EXPLORATION, lanes.worlds, from_turn)
        self._period: dict[str, AnyArray] = {}
        """Of the turns of this period that count, by name: "income" [B, N] and "steps" [B], their sums;
        "seen" [B, S], "stock", "done" and "terminated" [B], at the last of them. Empty before the first."""
        self._loss = torch.full((0, 1), float("nan"))
        """The loss of the last update of each replica, [R, 1]; [0, 1] before the first."""

    def store(self, turn: Turn) -> None:
        """Count a turn; at the end of a period store its transitions and learn."""
        if self.actor.seen is None:
            return
        entries = {
            "seen": turn.next_world[keys.SEEN],
            **{name: turn.next_world[name][:, 0] for name in (keys.STOCK, keys.DONE, keys.TERMINATED)},
        }
        now = {name: _copied(entry) for name, entry in entries.items()}
        paid = [_copied(turn.next_agents[key[-1]]) for key in (keys.HARVEST, keys.FINES, keys.TRANSFERS)]
        now["income"] = incomes_of(*paid)
        now["steps"] = np.ones(len(now["income"]), np.int64)
        if self._period:
            for name in ("income", "steps"):
                now[name] += self._period[name]
            ended = self._period[keys.DONE]
            for name, entry in now.items():
                entry[ended] = self._period[name][ended]
        self._period = now
        if self.actor.turns % self._governor.every_steps == 0:
            self._end_period()

    def _end_period(self) -> None:
        """Learn from a period, and forget it."""
        if self.learner is not None:
            batch = self._transitions()
            self.learner.store(batch)
            loss = self.learner.update()
            self.learner.end_episode(batch["next", keys.DONE][:, 0])
            self._loss = self._loss if loss is None else loss.cpu()
        self._period = {}

    def _transitions(self) -> TensorDict:
        """Return the period as a turn of agents of which the last is the governor."""
        assert self.actor.seen is not None
        assert self.actor.rule is not None
        stock = self._period["stock"] / len(self._game.map.sites)
        wanted = welfare(self._governor, self._period["income"], self._period["steps"], stock)
        reward = torch.as_tensor(wanted, dtype=torch.float32)[:, None]
        last = {name: torch.as_tensor(array) for name, array in self._period.items()}
        size = [len(reward)]
        after = {
            keys.AGENTS: TensorDict(
                {"observation": self._as_last(last["seen"]), "reward": self._as_last(reward)}, size
            ),
            **{name: last[name][:, None] for name in (keys.DONE, keys.TERMINATED)},
        }
        before = {
            "observation": self._as_last(self.actor.seen),
            "action": self._as_last(self.actor.rule),
        }
        return TensorDict({keys.AGENTS: TensorDict(before, size), "next": TensorDict(after, size)}, size)

    def _as_last(self, entry: Tensor) -> Tensor:
        """Return an entry of worlds, [B, ...], as that of N + 1 agents, [B, N + 1, ...]."""
        return entry[:, None].expand(-1, self._game.agents + 1, *entry.shape[1:])

    def numbers(self, replica: int) -> dict[str, float]:
        """Return what is logged beside an episode of a replica: how its governor learns."""
        if self.learner is None:
            return {}
        loss = float(self._loss[replica]) if len(self._loss) else float("nan")
        return {"governor/loss": loss, "governor/epsilon": self.learner.actor.epsilon}

    @property
    def learners(self) -> dict[tuple[int, ...], Learner]:
        """Return its learner by the agent after the last one; {} if it does not learn."""
        return {} if self.learner is None else {self.learner.agents: self.learner}

    def networks(self) -> dict[str, nn.Module]:
        """Return copies of its networks, by "replica_0/agent_N" and so on; none if it does not learn."""
        return {} if self.learner is None else self.learner.networks()

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

    def as_stored(self, replicas: Sequence[int]) -> list[StoredAgent]:
        """Return copies of the current governor of some replicas."""
        if not isinstance(self._spec, Learning):
            return [self._stored[replica - self._lanes.first_replica] for replica in replicas]
        networks = self.networks()
        lanes = [lane_name(replica, self._game.agents) for replica in replicas]
        return [trained_agent(self._spec, networks[lane], None) for lane in lanes]

    def _stored_actor(self, purpose: Purpose, worlds: int, from_turn: int = 0) -> GovernorActor:
        """Return the actor of a governor that does not learn, with random numbers for a purpose."""
        seeds = self._lanes.agent_seeds(purpose)
        return stored_governor(self._game, self._stored, seeds=seeds, worlds=worlds, from_turn=from_turn)

    def _load(self, spec: Frozen | Script, weights: Mapping[str, str]) -> list[StoredAgent]:
        """Return the governor of each replica, of an earlier run or a script; refuse one that sees or chooses
        from something else."""
        first = self._lanes.first_replica
        replicas = range(first, first + self._lanes.replicas)
        if not isinstance(spec, Frozen):
            return [StoredAgent(scripted=spec) for _ in replicas]
        run = load(spec.run, weights=weights.get(spec.run))
        there = run.game.governor if isinstance(run.game, Game) else None
        here = self._governor
        if there is None or (there.sees, there.options) != (here.sees, here.options):
            raise ValueError(
                f"the game of {run.path} has the governor {there}; allowed for {spec}: one that sees and "
                f"chooses from the same as {here}"
            )
        if spec.agent != run.game.agents:
            raise ValueError(f"governor is {spec}; allowed: the agent after the last one, {run.game.agents}")
        return [run.agent(spec.agent, replica=spec.replica_for(replica)) for replica in replicas]

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
