"""train: a training from its first step to its last."""

from collections import Counter, OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.collectors import BaseCollector
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from cprl import keys, recurrent_state
from cprl.envs.make_env import check_env, spaces_of
from cprl.envs.state import carried_state, env_state, load_carried, load_env_state
from cprl.envs.unwrap import commons_of
from cprl.keys import Turn
from cprl.learners.base import AnyLearner
from cprl.measuring.episodes import Episode, tracker_of
from cprl.measuring.series import Observer
from cprl.policies.assignment import AgentIndices, AgentPolicies
from cprl.policies.decisions import Decider
from cprl.runs.checkpoints import Checkpointer
from cprl.runs.files import TRAINING_STATE_FORMAT
from cprl.runs.schedule import Schedule
from cprl.system.times import Times
from cprl.training.finite import EVERY_TURNS, FiniteCheck
from cprl.training.learning import (
    LaneLosses,
    WantedReturns,
    check_agents,
    check_decisions,
    learned_in,
)
from cprl.values import Custom, checked, shown
from cprl.values.arrays import Float64


class StepCollector(BaseCollector):
    """Yields steps of all worlds one by one, batch size [B].

    Equivalent to `Collector(env, policy, frames_per_batch=B)` without its time axis of length 1, as a test
    checks, and several times faster. It does not stack, copy or track anything: batches contain the
    environment's own tensors. Environment and policy have states of their own, so that it has none.

    Args:
        env: B worlds, whose steps return new tensors.
    """

    def __init__(self, env: EnvBase, policy: nn.Module) -> None:
        super().__init__()
        self.env, self.policy = env, policy
        self.frames_per_batch = env.batch_size.numel()
        self.carried: TensorDictBase | None = None
        """The input of the environment's next step; None before the first step."""

    def iterator(self) -> Iterator[TensorDictBase]:
        if self.carried is None:
            self.carried = self.env.reset()
        while True:
            with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
                now, self.carried = self.env.step_and_maybe_reset(self.policy(self.carried))
                done = keys.entry(keys.entry(now, "next"), keys.DONE)
                recurrent_state.carry(self.carried, self.carried, done)
            yield now

    def set_seed(self, seed: int, static_seed: bool = False) -> int:
        return int(self.env.set_seed(seed, static_seed=static_seed))

    def shutdown(
        self, timeout: float | None = None, close_env: bool = True, raise_on_error: bool = True
    ) -> None:
        if close_env and not self.env.is_closed:
            self.env.close(raise_if_closed=raise_on_error)

    def state_dict(self) -> "OrderedDict[str, Any]":
        return OrderedDict()

    def load_state_dict(self, state_dict: "OrderedDict[str, Any]") -> None:
        pass


MakeCollector = Callable[[EnvBase, nn.Module], BaseCollector]
"""A collector out of an environment and a policy; it yields batches [B], or [B, T] of T turns."""


class Training:
    """A training that takes one turn after the other, and whose whole state can be read and set.

    All replicas take each turn together. A replica whose episodes are short plays on until the last one has
    played its last episode; callbacks get no episodes beyond those of the schedule. Episodes of a replica are
    counted in the order of the turns in which they end, and within a turn in that of its worlds.

    Args:
        env: W worlds of each replica R; world b belongs to replica b // W.
        learners: by the indices of their agents, a tuple; each updates these agents in every replica.
        schedule: how long each replica is trained, in how many worlds, and when its learners update.
        others: the actors of the agents that do not learn, likewise; an actor of one agent by its index.
        decisions: what all agents decide, and learn to, where the game asks them; see `Game.decisions`.
        callbacks: called after each turn and each episode, in this order; see `Callback`.
        metrics: the user's own, see `cprl.measuring.EpisodeTracker`.
        make_collector: what plays; one of TorchRL's own is several times slower, and cannot be resumed.
    """

    def __init__(
        self,
        env: EnvBase,
        learners: Mapping[tuple[int, ...], AnyLearner],
        schedule: Schedule,
        *,
        others: Mapping[AgentIndices, nn.Module] | None = None,
        decisions: Decider | None = None,
        callbacks: Sequence[Any] = (),
        metrics: Sequence[Custom] = (),
        make_collector: MakeCollector = StepCollector,
    ) -> None:
        schedule = checked("schedule", schedule, Schedule)
        spaces = spaces_of(env)
        check_env(env, env.batch_size.numel())
        check_callbacks(callbacks)
        self.env = env
        self.schedule = schedule
        self.learners = dict(learners)
        self.others = dict(others or {})
        self.decisions = decisions
        self.replicas = check_agents(env, spaces.agents, schedule.worlds, self.learners, self.others)
        for learner in self.learners.values():
            schedule.refuse_rollouts(getattr(learner.settings, "rollout_steps", schedule.update_every))
        commons = commons_of(env)
        check_decisions(decisions, 0 if commons is None else commons.game.decisions)
        actors: dict[AgentIndices, nn.Module] = {
            agents: learner.actor for agents, learner in self.learners.items()
        }
        self._collector = make_collector(env, AgentPolicies({**actors, **self.others}, decisions=decisions))
        self._batches = iter(self._collector)
        self._tracker = tracker_of(env, metrics)
        self._losses = {agents: LaneLosses(self.replicas, agents) for agents in self.learners}
        self._wanted = WantedReturns(env.batch_size.numel(), spaces.agents, self.learners)
        for learner in self.learners.values():
            learner.begin()
        self.finite = FiniteCheck(self.learners, spaces, worlds=schedule.worlds, on_nan=schedule.on_nan)
        self.observer = Observer(callbacks, env, worlds=schedule.worlds)
        """What calls the callbacks."""
        self._played = [0] * self.replicas
        self.steps = 0
        """Steps of each replica so far."""
        self.times = Times()

    def __repr__(self) -> str:
        return f"Training({self.env!r}, {self.steps} steps of {self.schedule.length})"

    @property
    def is_over(self) -> bool:
        return self.schedule.is_over(self._played, self.steps)

    @property
    def is_ending(self) -> bool:
        """Whether a replica may play its last episode in the next turn, see `Schedule.is_ending`."""
        return self.schedule.is_ending(self._played, self.steps)

    @property
    def is_sound(self) -> bool:
        """Whether everything was finite so far; with `on_nan` "stop" a training that goes on always is."""
        return not self.finite.reported

    @property
    def episodes_played(self) -> int:
        """Episodes that all replicas together have ended so far, those beyond its length left out."""
        return sum(self.episodes_by_replica)

    @property
    def episodes_by_replica(self) -> list[int]:
        """Likewise, of each replica."""
        return [self.schedule.counted(played) for played in self._played]

    @property
    def callbacks(self) -> list[Any]:
        return self.observer.callbacks

    def start(self) -> None:
        """Calls `on_start` of the callbacks; `run` does before the first step."""
        self.observer.on_start(self)

    def run(self, checkpointer: Checkpointer | None = None) -> None:
        """Takes all steps, from the newest checkpoint on if there is one."""
        if checkpointer is not None:
            self.state_dict()  # what cannot be saved is refused now, not when the first checkpoint is due
            checkpointer.restore(self)
        self.start()
        while not self.is_over:
            self.step()
            if checkpointer is not None:
                checkpointer.after_step(self)

    def step(self) -> None:
        """The turns that the collector yields, one as a rule: act, store, update, measure, record."""
        for batch in self._act():
            turn = Turn.of(batch)
            self.steps += self.schedule.worlds
            turns = self.steps // self.schedule.worlds
            with self.times:
                self._store(turn)
                if turns % self.schedule.update_every == 0:
                    for _ in range(self.schedule.update_every):
                        self._update()
            self.observer.on_step(batch)
            ended = self._tracker.add(turn)
            if ended:
                self._check_finite(ended, weights=True)
                learned = self._end(ended, turn)
                self._record(ended, learned)
            elif turns % EVERY_TURNS == 0:
                self._check_finite()

    def _act(self) -> Sequence[TensorDictBase]:
        """The next turns of every world, one as a rule, [B] each."""
        with self.times:
            batch = next(self._batches)
        return [batch] if batch.batch_dims == 1 else batch.unbind(1)

    def _store(self, turn: Turn) -> None:
        self.finite.add(turn)
        for learner in self.learners.values():
            learner.store(turn)
        self._wanted.add()

    def _update(self) -> None:
        for agents, learner in self.learners.items():
            try:
                loss = learner.update()
            except (RuntimeError, ValueError):  # some losses refuse NaN in words of their own
                self._check_finite(weights=True)
                raise
            self._losses[agents].add(loss)

    def _check_finite(self, ended: Sequence[Episode] = (), *, weights: bool = False) -> None:
        returns = self._tracker.returns
        for episode in ended:
            returns[episode.world] = episode.return_
        self.finite.check(self._losses, returns, self.steps, weights=weights)

    def _end(self, ended: Sequence[Episode], turn: Turn) -> list[dict[str, float]]:
        """Ends episodes of the learners; returns what was learned in each."""
        worlds = [episode.world for episode in ended]
        learned = learned_in(worlds, turn, self.learners, self._losses, self.schedule.worlds)
        has_ended = torch.zeros(self.env.batch_size, dtype=torch.bool)
        has_ended[worlds] = True
        for learner in self.learners.values():
            learner.end_episode(has_ended)
        return learned

    def _record(self, ended: Sequence[Episode], learned: Sequence[dict[str, float]]) -> None:
        """Counts episodes that have ended, and hands those of the schedule to the callbacks."""
        recorded: list[tuple[Episode, dict[str, float]]] = []
        for episode, of_agents in zip(ended, learned, strict=True):
            replica = episode.world // self.schedule.worlds
            wanted = self._wanted.take(episode.world)
            number = self._played[replica]
            episode = replace(episode, replica=replica, episode=number, wanted_return=wanted)
            if self.decisions is not None and episode.decision is not None:
                returns = np.where(np.isnan(wanted), episode.return_, wanted)
                self.decisions.learn(replica, episode.decision, returns)
            self._played[replica] += 1
            if self.schedule.counted(number + 1) > number:
                recorded.append((episode, of_agents))
        if recorded:
            self.observer.on_ended(recorded)

    def state_dict(self) -> dict[str, Any]:
        """Everything that the future depends on, in tensors, numbers, lists and dicts; not copies.

        Raises:
            ValueError: where the collector has no state to resume from.
            NotFiniteError: where weights are not finite, unless `on_nan` is "continue".
        """
        carried = self._step_collector().carried
        self._check_finite(weights=True)
        self.finite.saved_step = self.steps
        return {
            "format": TRAINING_STATE_FORMAT,
            "steps": self.steps,
            "played": list(self._played),
            "env": env_state(self.env),
            "carried": None if carried is None else carried_state(carried),
            "callbacks": {name: callback.state_dict() for name, callback in self._with_state().items()},
            "torch": torch.get_rng_state(),
            **{name: [dict(part.state_dict()) for part in parts] for name, parts in self._parts().items()},
        }

    def _parts(self) -> dict[str, list[Any]]:
        """What has a state of its own, by its name in a state of the training."""
        return {
            "learners": list(self.learners.values()),
            "others": list(self.others.values()),
            "decisions": [] if self.decisions is None else [self.decisions],
            "losses": list(self._losses.values()),
            "wanted": [self._wanted],
            "tracker": [self._tracker],
            "observer": [self.observer],
            "finite": [self.finite],
            "times": [self.times],
        }

    def _with_state(self) -> dict[str, Any]:
        """The callbacks that have a state, by the name of their class; a second one of a class gets a 2."""
        named: dict[str, Any] = {}
        of_kind: Counter[str] = Counter()
        for callback in self.callbacks:
            if hasattr(callback, "state_dict") and hasattr(callback, "load_state_dict"):
                kind = type(callback).__name__
                of_kind[kind] += 1
                named[kind if of_kind[kind] == 1 else f"{kind} {of_kind[kind]}"] = callback
        return named

    def _step_collector(self) -> StepCollector:
        if not isinstance(self._collector, StepCollector):
            kind = type(self._collector).__name__
            raise ValueError(
                f"a {kind} has no state to resume from; train with a StepCollector, or without a checkpointer"
            )
        return self._collector

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Resumes exactly where the training of that state was, which was made with the same arguments."""
        form = state.get("format", 1)
        if form != TRAINING_STATE_FORMAT:
            raise ValueError(
                f"the state has the format {form}, this version resumes "
                f"{TRAINING_STATE_FORMAT}; finish the run with the version that began it, whose commit is in "
                "its recipe.json"
            )
        self.steps = int(state["steps"])
        self._played = list(state["played"])
        fresh = self.env.reset()  # the form of what is carried; the state then says where the worlds are
        load_env_state(self.env, state["env"])
        if state["carried"] is not None:
            self._step_collector().carried = load_carried(fresh, state["carried"])
        for name, parts in self._parts().items():
            for part, part_state in zip(parts, state[name], strict=True):
                part.load_state_dict(part_state)
        for name, callback in self._with_state().items():
            if name in state["callbacks"]:  # a viewer may be added or left out from now on
                callback.load_state_dict(state["callbacks"][name])
        torch.set_rng_state(state["torch"])


def train(
    env: EnvBase,
    learners: Mapping[tuple[int, ...], AnyLearner],
    schedule: Schedule,
    *,
    others: Mapping[AgentIndices, nn.Module] | None = None,
    decisions: Decider | None = None,
    callbacks: Sequence[Any] = (),
    metrics: Sequence[Custom] = (),
    make_collector: MakeCollector = StepCollector,
    checkpointer: Checkpointer | None = None,
) -> Training:
    """Plays so many episodes, or takes so many steps, of every replica; each learner stores every turn and
    then updates.

    Args:
        checkpointer: says where the training resumes from, and saves its state now and then. For the others
            see `Training`.

    Returns:
        The `Training`, which is over.

    Raises:
        NotFiniteError: where a number is not finite, before a checkpoint holds it.
    """
    training = Training(
        env,
        learners,
        schedule,
        others=others,
        decisions=decisions,
        callbacks=callbacks,
        metrics=metrics,
        make_collector=make_collector,
    )
    training.run(checkpointer)
    return training


class Callback(Protocol):
    """What is called while a training runs; each method may be missing.

    With `state_dict` and `load_state_dict` its state is part of the training's checkpoints.
    """

    def on_start(self, training: Any) -> None:
        """The `Training` is about to take its first step, or the first after a checkpoint."""

    def on_step(self, batch: TensorDictBase) -> None:
        """One turn of every world, as the collector yields it, [B]."""

    def on_ended(self, ended: Sequence[tuple[Episode, dict[str, float]]]) -> None:
        """Episodes of some replicas have ended in one turn: all of them, with what was learned in each,
        before `on_episode` is called with one after the other."""

    def on_episode(self, episode: Episode, learning: dict[str, float]) -> None:
        """An episode has ended; what was learned in it: `agent_0/loss`, `agent_0/epsilon`, ...

        A number that is written into `learning` under a name of one's own is logged with the others, by the
        loggers and the viewer of a run, and by callbacks that come later in a `Training`.
        """

    def on_numbers(self, episode: int, numbers: dict[str, Float64]) -> None:
        """All replicas have ended an episode, counted from 0: its numbers by name, [R] of each replica, NaN
        where undefined; of replicas in W worlds the last of W, whose means these are.

        Those of the whole training, `time/env_steps` and `time/env_steps_per_s`, are of length 1.
        """

    def on_finished(self, run: Path) -> None:
        """All of a run is written and said; by `cprl.run` alone, with the run's directory."""


HOOKS: Final = ("on_start", "on_step", "on_ended", "on_episode", "on_numbers", "on_finished")


def check_callbacks(callbacks: Sequence[Any]) -> None:
    """Refuses a callback that nothing would call."""
    for callback in callbacks:
        if not any(hasattr(callback, hook) for hook in HOOKS):
            raise ValueError(
                f"the callback {shown(callback)} has none of the methods {', '.join(HOOKS)}: nothing would "
                "call it"
            )
