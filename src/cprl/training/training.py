"""train: a training from its first step to its last."""

import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.collectors import BaseCollector
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from cprl.envs.make_env import check_env, spaces_of
from cprl.envs.state import carried_state, env_state, load_carried, load_env_state
from cprl.envs.stepping import begin_states
from cprl.envs.unwrap import commons_of
from cprl.experiment.experiment import OnNan
from cprl.keys import Turn
from cprl.learners.base import Learner
from cprl.measuring.episodes import Episode, tracker_of
from cprl.measuring.series import Observer
from cprl.policies.assignment import AgentIndices, AgentPolicies
from cprl.policies.decisions import Decider
from cprl.runs.checkpoints import Checkpointer
from cprl.runs.files import TRAINING_STATE_FORMAT
from cprl.runs.length import Length
from cprl.system.times import Times
from cprl.training.finite import EVERY_TURNS, FiniteCheck
from cprl.training.learning import (
    LaneLosses,
    WantedReturns,
    check_agents,
    check_decisions,
    check_numbers,
    learned_in,
    losses_of,
)
from cprl.values import Custom, shown
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
                begin_states(self.carried, self.carried, now)
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
    played its last episode; callbacks get no episodes beyond `episodes`. Episodes of a replica are counted in
    the order of the turns in which they end, and within a turn in that of its worlds.

    Args:
        env: W worlds of each replica R; world b belongs to replica b // W.
        learners: by the indices of their agents, a tuple; each updates these agents in every replica.
        episodes: how many each replica plays, at least 1; or `steps`.
        steps: how many each replica takes, at least 1; a turn of W worlds is W steps.
        worlds: the worlds W of each replica.
        others: the actors of the agents that do not learn, likewise; an actor of one agent by its index.
        decisions: what all agents decide, and learn to, where the game asks them; see `Game.decisions`.
        callbacks: called after each turn and each episode, in this order; see `Callback`.
        update_every: turns k after which each learner updates, then k times.
        make_collector: what plays; one of TorchRL's own is several times slower, and cannot be resumed.
        on_nan: whether the training stops where a loss, weight, reward or observation is not finite, see
            `cprl.training.finite`.
        metrics: the user's own, see `cprl.measuring.EpisodeTracker`.
    """

    def __init__(
        self,
        env: EnvBase,
        learners: Mapping[tuple[int, ...], Learner],
        *,
        episodes: int | None = None,
        steps: int | None = None,
        worlds: int = 1,
        others: Mapping[AgentIndices, nn.Module] | None = None,
        decisions: Decider | None = None,
        callbacks: Sequence[Any] = (),
        update_every: int = 1,
        make_collector: MakeCollector = StepCollector,
        on_nan: OnNan = "stop",
        metrics: Sequence[Custom] = (),
    ) -> None:
        spaces = spaces_of(env)
        check_env(env, env.batch_size.numel())
        check_callbacks(callbacks)
        self.env = env
        self.worlds = worlds
        self.update_every = update_every
        self.learners, self.others = dict(learners), dict(others or {})
        check_numbers(episodes, steps, worlds, update_every, self.learners)
        self.length = Length.of({"episodes": episodes, "steps": steps})
        self.replicas = check_agents(env, spaces.agents, worlds, self.learners, self.others)
        actors: dict[AgentIndices, nn.Module] = {
            agents: learner.actor for agents, learner in self.learners.items()
        }
        commons = commons_of(env)
        check_decisions(decisions, 0 if commons is None else commons.game.decisions)
        self.decisions = decisions
        self._collector = make_collector(env, AgentPolicies({**actors, **self.others}, decisions=decisions))
        self._turns = iter(self._collector)
        self._tracker = tracker_of(env, metrics)
        self._losses = {agents: LaneLosses(self.replicas, agents) for agents in self.learners}
        self._wanted = WantedReturns(self.replicas * worlds, spaces.agents, self.learners)
        for learner in self.learners.values():
            learner.begin()
        self.finite = FiniteCheck(self.learners, spaces, worlds=worlds, on_nan=on_nan)
        self.observer = Observer(callbacks, env, worlds=worlds)
        """What calls the callbacks."""
        self._played = [0] * self.replicas
        self.steps = 0
        """Steps of each replica so far."""
        self.times = Times()

    def __repr__(self) -> str:
        return f"Training({self.env!r}, {self.steps} steps of {self.length})"

    @property
    def is_over(self) -> bool:
        return self.length.is_over(episodes=min(self._played), steps=self.steps)

    @property
    def _most_episodes(self) -> float:
        return inf if self.length.is_of_steps else self.length.number

    @property
    def is_sound(self) -> bool:
        """Whether everything was finite so far; with `on_nan` "stop" a training that goes on always is."""
        return not self.finite.reported

    @property
    def is_ending(self) -> bool:
        """Whether a replica may play its last episode in the next turn, in which each of its worlds can end
        one; episodes that it plays beyond are not recorded. Of a training of so many steps: whether it is
        over."""
        if self.length.is_of_steps:
            return self.is_over
        return max(self._played) > self.length.number - self.worlds

    @property
    def episodes_played(self) -> int:
        """Episodes that all replicas together have ended so far, those beyond its length left out."""
        return sum(self.episodes_by_replica)

    @property
    def episodes_by_replica(self) -> list[int]:
        """Likewise, of each replica."""
        return [int(min(played, self._most_episodes)) for played in self._played]

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
        began = time.perf_counter()
        batch = next(self._turns)
        self.times.busy_s += time.perf_counter() - began
        for turn in [batch] if batch.batch_dims == 1 else batch.unbind(1):
            self._take(turn)

    def _take(self, batch: TensorDictBase) -> None:
        self.steps += self.worlds
        turns = self.steps // self.worlds
        began = time.perf_counter()
        turn = Turn.of(batch)
        self.finite.add(turn)
        for learner in self.learners.values():
            learner.store(turn)
        self._wanted.add()
        if turns % self.update_every == 0:
            for _ in range(self.update_every):
                for agents, learner in self.learners.items():
                    self._losses[agents].add(self._update(learner))
        self.times.busy_s += time.perf_counter() - began
        self.observer.on_step(batch)
        ended = self._tracker.add(turn)
        if ended:
            self._end(ended, turn)
        elif turns % EVERY_TURNS == 0:
            self._check_finite()

    def _update(self, learner: Learner) -> Tensor | None:
        try:
            return learner.update()
        except (RuntimeError, ValueError):  # some losses refuse NaN in words of their own
            self._check_finite(weights=True)
            raise

    def _check_finite(self, ended: Sequence[Episode] = (), *, weights: bool = False) -> None:
        returns = self._tracker.returns
        for episode in ended:
            returns[episode.world] = episode.return_
        self.finite.check(self._losses, returns, self.steps, weights=weights)

    def _end(self, ended: Sequence[Episode], turn: Turn) -> None:
        self._check_finite(ended, weights=True)
        worlds = torch.zeros(self.replicas * self.worlds, dtype=torch.bool)
        worlds[[episode.world for episode in ended]] = True
        values = {agents: learner.values(turn).tolist() for agents, learner in self.learners.items()}
        replicas = {episode.world // self.worlds for episode in ended}
        losses = {replica: losses_of(replica, self._losses) for replica in replicas}
        learning = [
            learned_in(episode.world, self.learners, losses[episode.world // self.worlds], values)
            for episode in ended
        ]
        for learner in self.learners.values():
            learner.end_episode(worlds)
        recorded: list[tuple[Episode, dict[str, float]]] = []
        for episode, of_agents in zip(ended, learning, strict=True):
            replica, wanted = episode.world // self.worlds, self._wanted.take(episode.world)
            number = self._played[replica]
            episode = replace(episode, replica=replica, episode=number, wanted_return=wanted)
            if self.decisions is not None and episode.decision is not None:
                returns = np.where(np.isnan(wanted), episode.return_, wanted)
                self.decisions.learn(replica, episode.decision, returns)
            self._played[replica] += 1
            if number < self._most_episodes:
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
            **self.times.state_dict(),
            "played": list(self._played),
            "env": env_state(self.env),
            "carried": None if carried is None else carried_state(carried),
            "learners": [learner.state_dict() for learner in self.learners.values()],
            "others": [dict(other.state_dict()) for other in self.others.values()],
            "decisions": {} if self.decisions is None else dict(self.decisions.state_dict()),
            "losses": [losses.state_dict() for losses in self._losses.values()],
            "wanted": self._wanted.state_dict(),
            "tracker": self._tracker.state_dict(),
            "observer": self.observer.state_dict(),
            "callbacks": {name: callback.state_dict() for name, callback in self._with_state().items()},
            "not_finite": self.finite.state_dict(),
            "torch": torch.get_rng_state(),
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
        if state.get("format", 1) != TRAINING_STATE_FORMAT:
            raise ValueError(
                f"the state has the format {state.get('format', 1)}, this version resumes "
                f"{TRAINING_STATE_FORMAT}; finish the run with the version that began it, whose commit is in "
                "its recipe.json"
            )
        self.times.load_state_dict(state)
        self.steps, self._played = int(state["steps"]), list(state["played"])
        fresh = self.env.reset()  # the form of what is carried; the state then says where the worlds are
        load_env_state(self.env, state["env"])
        if state["carried"] is not None:
            self._step_collector().carried = load_carried(fresh, state["carried"])
        parts: dict[str, Any] = {"learners": self.learners, "others": self.others, "losses": self._losses}
        for name, of_agents in parts.items():
            for part, part_state in zip(of_agents.values(), state[name], strict=True):
                part.load_state_dict(part_state)
        self._wanted.load_state_dict(state["wanted"])
        if self.decisions is not None:
            self.decisions.load_state_dict(state["decisions"])
        self._tracker.load_state_dict(state["tracker"])
        self.observer.load_state_dict(state["observer"])
        self.finite.load_state_dict(state["not_finite"], step=self.steps)
        for name, callback in self._with_state().items():
            if name in state["callbacks"]:  # a viewer may be added or left out from now on
                callback.load_state_dict(state["callbacks"][name])
        torch.set_rng_state(state["torch"])


def train(
    env: EnvBase,
    learners: Mapping[tuple[int, ...], Learner],
    *,
    checkpointer: Checkpointer | None = None,
    **how: Any,
) -> Training:
    """Plays so many episodes, or takes so many steps, of every replica; each learner stores every turn and
    then updates.

    Args:
        checkpointer: says where the training resumes from, and saves its state now and then.
        how: the other arguments of `Training`.

    Returns:
        The `Training`, which is over.

    Raises:
        NotFiniteError: where a number is not finite, before a checkpoint holds it.
    """
    training = Training(env, learners, **how)
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
