"""Training: the loop from the first step to the last; train, and what callbacks get."""

from bisect import bisect_right
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import accumulate
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.collectors import BaseCollector
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from cprl import keys
from cprl.commons.spaces import Spaces
from cprl.envs.env_state import env_state, load_env_state, load_transforms_state, transforms_state
from cprl.envs.make_env import check_env, spaces_of
from cprl.envs.unwrap import commons_game_of
from cprl.keys import Turn, recurrent_state
from cprl.learners.learner import Learner
from cprl.measuring.series import Observer
from cprl.measuring.tracker import Episode, example_episode, tracker_of, with_missing
from cprl.policies.decisions import Decider
from cprl.policies.joint_policy import ActorAgents, JointPolicy
from cprl.runs.checkpoints import Checkpointer
from cprl.runs.files import TRAINING_STATE_FORMAT
from cprl.runs.schedule import Schedule
from cprl.system.times import Times
from cprl.training.governing import Governing
from cprl.training.learning import (
    LaneLosses,
    ShapedReturns,
    check_decisions,
    check_learners,
    learning_numbers,
)
from cprl.training.nan_check import EVERY_TURNS, FiniteCheck
from cprl.values import Custom, checked, describe_changes, short_repr, to_config
from cprl.values.array_types import Float64


class StepCollector(BaseCollector):
    """A collector that yields steps of all worlds one by one, batch size [B].

    Equivalent to `Collector(env, policy, frames_per_batch=B)` without its time axis of length 1, as a test
    checks, and several times faster. It does not stack, copy or track anything: batches contain the
    environment's own tensors. Environment and policy have states of their own, so that it has none.

    Args:
        env: B worlds, whose steps return new tensors.
    """

    def __init__(self, env: EnvBase, policy: nn.Module) -> None:
        super().__init__()
        self.env = env
        self.policy = policy
        self.frames_per_batch = env.batch_size.numel()
        self.carried: TensorDictBase | None = None
        """The input of the environment's next step; None before the first step."""

    def play_in(self, env: EnvBase) -> None:
        """Begin new episodes in other worlds with the next step."""
        self.env = env
        self.carried = env.reset()

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
"""A function from an environment and a policy to a collector, which yields batches [B], or [B, T] of T
turns."""


class Training:
    """The training loop of all replicas, with a state that can be saved and restored at any turn.

    All replicas take each turn together. A replica with short episodes plays on until every replica has
    reached the length of the schedule; callbacks do not get its additional episodes. Episodes of a replica
    are counted in the order in which they end, those of one turn by world.

    Args:
        env: W worlds of each replica R; world b belongs to replica b // W.
        learners: the learners by the indices of their agents, a tuple; each updates these agents in every
            replica.
        schedule: the length of the training, the worlds of each replica, and the turns between updates.
        others: the actors of the agents that do not learn, by their indices; an actor of one agent by its
            index.
        decisions: the decisions of all agents on the game's ballots, and how they learn them; see
            `Game.decisions`.
        governor: decides, and learns, in a game with a `Governor`; None leaves its first option in force.
        callbacks: called after each turn and each episode, in this order; see `Callback`.
        metrics: custom metrics, see `cprl.measuring.EpisodeTracker`.
        make_collector: makes the collector; those of TorchRL are several times slower, and cannot be resumed.
        earlier: the worlds that agents play in before those of `env`, in this order, each with the steps of
            each replica there, see `cprl.Experiment.earlier`.
    """

    def __init__(
        self,
        env: EnvBase,
        learners: Mapping[tuple[int, ...], Learner],
        schedule: Schedule,
        *,
        others: Mapping[ActorAgents, nn.Module] | None = None,
        decisions: Decider | None = None,
        governor: Governing | None = None,
        callbacks: Sequence[Any] = (),
        metrics: Sequence[Custom] = (),
        make_collector: MakeCollector = StepCollector,
        earlier: Sequence[tuple[EnvBase, int]] = (),
    ) -> None:
        schedule = checked("schedule", schedule, Schedule)
        spaces = spaces_of(env)
        check_env(env, env.batch_size.numel())
        check_callbacks(callbacks)
        self._envs = [*(earlier_env for earlier_env, _ in earlier), env]
        """The worlds of all games, in the order in which they are played."""
        self._changes = list(accumulate(steps for _, steps in earlier))
        """The steps of each replica at which the next game begins."""
        for earlier_env in self._envs[:-1]:
            _refuse_other_spaces(earlier_env, env, spaces)
        self.env = self._envs[0]
        """The worlds that are played in now."""
        self.schedule = schedule
        self.learners = dict(learners)
        self.others = dict(others or {})
        self.decisions = decisions
        self.governor = governor
        self.replicas = check_learners(env, schedule.worlds, self.learners)
        for learner in self.learners.values():
            schedule.refuse_rollouts(getattr(learner.settings, "rollout_steps", schedule.update_every))
        check_decisions(decisions, commons_game_of(env))
        actors: dict[ActorAgents, nn.Module] = {
            agents: learner.actor for agents, learner in self.learners.items()
        }
        policy = JointPolicy(
            {**actors, **self.others},
            decisions=decisions,
            governor=None if governor is None else governor.actor,
        )
        policy.refuse_other_agents(spaces.agents)
        self._collector = make_collector(self.env, policy)
        if earlier and not isinstance(self._collector, StepCollector):
            raise ValueError(
                f"make_collector is {short_repr(make_collector)}; allowed with earlier: StepCollector"
            )
        self._batches = iter(self._collector)
        self._metrics = metrics
        self._examples = [example_episode(played, metrics) for played in self._envs] if earlier else []
        """An episode of each game, whose numbers the episodes of all games have."""
        self._tracker = tracker_of(self.env, metrics)
        self._losses = {agents: LaneLosses(self.replicas, agents) for agents in self.learners}
        self._shaped_returns = ShapedReturns(env.batch_size.numel(), spaces.agents, self.learners)
        for learner in self.learners.values():
            learner.begin()
        all_learners = dict(self.learners)
        if governor is not None and governor.learner is not None:
            all_learners[governor.learner.agents] = governor.learner
        self.finite = FiniteCheck(all_learners, spaces, worlds=schedule.worlds, on_nan=schedule.on_nan)
        self.observer = Observer(callbacks, env, worlds=schedule.worlds)
        """The caller of the callbacks."""
        self._ended_episodes = [0] * self.replicas
        """The episodes that each replica has ended, also those beyond the training's length."""
        self.steps = 0
        """Steps of each replica so far."""
        self.times = Times()
        """The seconds spent on acting, storing and updating, and on compiling."""

    def __repr__(self) -> str:
        return f"Training({self.env!r}, {self.steps} steps of {self.schedule.length})"

    @property
    def is_over(self) -> bool:
        return self.schedule.is_over(self._ended_episodes, self.steps)

    @property
    def is_ending(self) -> bool:
        """Return whether a replica may play its last episode in the next turn, see `Schedule.is_ending`."""
        return self.schedule.is_ending(self._ended_episodes, self.steps)

    @property
    def is_finite(self) -> bool:
        """Return whether everything was finite so far; always true while a training with `on_nan` "stop"
        runs."""
        return not self.finite.reported

    @property
    def episodes_played(self) -> int:
        """Return the episodes that all replicas together have ended, without those beyond the training's
        length."""
        return sum(self.episodes_by_replica)

    @property
    def episodes_by_replica(self) -> list[int]:
        """Return the episodes that each replica has ended, without those beyond the training's length."""
        return [self.schedule.counted(played) for played in self._ended_episodes]

    @property
    def callbacks(self) -> list[Any]:
        return self.observer.callbacks

    def start(self) -> None:
        """Call `on_start` of the callbacks; `run` does before the first step."""
        self.observer.on_start(self)

    def run(self, checkpointer: Checkpointer | None = None) -> None:
        """Take all steps, from the newest checkpoint on if there is one."""
        if checkpointer is not None:
            self.state_dict()  # refuse what cannot be saved now, not at the first checkpoint
            checkpointer.restore(self)
        self.start()
        while not self.is_over:
            self.step()
            if checkpointer is not None:
                checkpointer.after_step(self)

    def step(self) -> None:
        """Take the next turns, usually one: act, store, update, measure, record."""
        for batch in self._next_turns():
            turn = played = Turn.of(batch)
            self.steps += self.schedule.worlds
            turns = self.steps // self.schedule.worlds
            next_env = self._envs[self._game_at(self.steps)]
            if next_env is not self.env:
                batch = _cut(batch)
                turn = Turn.of(batch)
            with self.times:
                self._store_turn(turn)
                if turns % self.schedule.update_every == 0:
                    for _ in range(self.schedule.update_every):
                        self._update_learners()
            self.observer.on_step(batch)
            ended = self._tracker.add(played)
            if ended:
                self._check_finite(ended, weights=True)
                learning = self._end_episodes(ended, turn)
                self._record_episodes(ended, learning)
            elif turns % EVERY_TURNS == 0:
                self._check_finite()
            if next_env is not self.env:
                self._change_game(next_env)

    def _game_at(self, steps: int) -> int:
        """Return the index of the game that is played after some steps of each replica."""
        return bisect_right(self._changes, steps)

    def _change_game(self, env: EnvBase) -> None:
        """Play in other worlds from the next step on, and say so to the callbacks."""
        changes = _changes_between(self.env, env)
        for world in range(env.batch_size.numel()):
            self._shaped_returns.take(world)
        self._play_in(env)
        self.observer.on_game(env, changes)

    def _play_in(self, env: EnvBase) -> None:
        load_transforms_state(env, transforms_state(self.env))
        self.env = env
        self._step_collector().play_in(env)
        self._tracker = tracker_of(env, self._metrics)

    def _next_turns(self) -> Sequence[TensorDictBase]:
        """Return the next turns of every world, usually one, [B] each."""
        with self.times:
            batch = next(self._batches)
        return [batch] if batch.batch_dims == 1 else batch.unbind(1)

    def _store_turn(self, turn: Turn) -> None:
        self.finite.add(turn)
        for learner in self.learners.values():
            learner.store(turn)
        if self.governor is not None:
            self.governor.store(turn)
        self._shaped_returns.add()

    def _update_learners(self) -> None:
        for agents, learner in self.learners.items():
            try:
                loss = learner.update()
            except (RuntimeError, ValueError):  # some losses raise errors of their own for NaN
                self._check_finite(weights=True)
                raise
            self._losses[agents].add(loss)

    def _check_finite(self, ended: Sequence[Episode] = (), *, weights: bool = False) -> None:
        returns = self._tracker.returns
        for episode in ended:
            returns[episode.world] = episode.return_
        self.finite.check(self._losses, returns, self.steps, weights=weights)

    def _end_episodes(self, ended: Sequence[Episode], turn: Turn) -> list[dict[str, float]]:
        """End episodes of the learners; return the numbers of learning of each."""
        worlds = [episode.world for episode in ended]
        learned = learning_numbers(worlds, turn, self.learners, self._losses, self.schedule.worlds)
        has_ended = torch.zeros(self.env.batch_size, dtype=torch.bool)
        has_ended[worlds] = True
        for learner in self.learners.values():
            learner.end_episode(has_ended)
        return learned

    def _record_episodes(self, ended: Sequence[Episode], learned: Sequence[dict[str, float]]) -> None:
        """Count episodes that have ended, and hand those within the schedule to the callbacks."""
        recorded: list[tuple[Episode, dict[str, float]]] = []
        for episode, numbers in zip(ended, learned, strict=True):
            replica = episode.world // self.schedule.worlds
            if self.governor is not None:
                numbers |= self.governor.numbers(replica)
            shaped = self._shaped_returns.take(episode.world)
            number = self._ended_episodes[replica]
            episode = replace(episode, replica=replica, episode=number, wanted_return=shaped)
            episode = with_missing(episode, self._examples) if self._examples else episode
            if self.decisions is not None and episode.decision is not None:
                returns = np.where(np.isnan(shaped), episode.return_, shaped)
                self.decisions.learn(replica, episode.decision, returns)
            self._ended_episodes[replica] += 1
            if self.schedule.counted(number + 1) > number:
                recorded.append((episode, numbers))
        if recorded:
            self.observer.on_ended(recorded)

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the future of the training depends on, as tensors, numbers, lists and dicts,
        uncopied.

        Raises:
            ValueError: if the collector has no state to resume from.
            NotFiniteError: if weights are not finite, unless `on_nan` is "continue".
        """
        carried = self._step_collector().carried
        self._check_finite(weights=True)
        self.finite.saved_step = self.steps
        return {
            "format": TRAINING_STATE_FORMAT,
            "steps": self.steps,
            "played": list(self._ended_episodes),
            "env": env_state(self.env),
            "carried": None if carried is None else carried.to_dict(),
            "callbacks": {
                name: callback.state_dict() for name, callback in self._stateful_callbacks().items()
            },
            "torch": torch.get_rng_state(),
            **{name: _states(parts) for name, parts in self._stateful_parts().items()},
        }

    def _stateful_parts(self) -> dict[str, list[Any]]:
        """Return the parts that have a state, by their names in the state of the training."""
        return {
            "learners": list(self.learners.values()),
            "others": list(self.others.values()),
            "decisions": [] if self.decisions is None else [self.decisions],
            "governor": [] if self.governor is None else [self.governor],
            "losses": list(self._losses.values()),
            "wanted": [self._shaped_returns],
            "tracker": [self._tracker],
            "observer": [self.observer],
            "finite": [self.finite],
            "times": [self.times],
        }

    def _stateful_callbacks(self) -> dict[str, Any]:
        """Return the callbacks that have a state, by the name of their class; a second one of a class gets a
        2."""
        callbacks: dict[str, Any] = {}
        counts: Counter[str] = Counter()
        for callback in self.callbacks:
            if hasattr(callback, "state_dict") and hasattr(callback, "load_state_dict"):
                name = type(callback).__name__
                counts[name] += 1
                if counts[name] > 1:
                    name = f"{name} {counts[name]}"
                callbacks[name] = callback
        return callbacks

    def _step_collector(self) -> StepCollector:
        if not isinstance(self._collector, StepCollector):
            kind = type(self._collector).__name__
            raise ValueError(
                f"a {kind} has no state to resume from; train with a StepCollector, or without a checkpointer"
            )
        return self._collector

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Resume exactly from the state of a training that was made with the same arguments."""
        format_number = state.get("format", 1)
        if format_number != TRAINING_STATE_FORMAT:
            raise ValueError(
                f"the state has the format {format_number}, this version resumes "
                f"{TRAINING_STATE_FORMAT}; finish the run with the version that began it, whose commit is in "
                "its recipe.json"
            )
        self.steps = int(state["steps"])
        self._ended_episodes = list(state["played"])
        env = self._envs[self._game_at(self.steps)]
        if env is not self.env:
            self._play_in(env)
        template = self.env.reset()  # has the form of `carried`; the state of the worlds is loaded below
        load_env_state(self.env, state["env"])
        if state["carried"] is not None:
            self._step_collector().carried = template.empty(recurse=True).update(state["carried"])
        for name, parts in self._stateful_parts().items():
            for part, part_state in zip(parts, state[name], strict=True):
                part.load_state_dict(part_state)
        for name, callback in self._stateful_callbacks().items():
            if name in state["callbacks"]:  # a resumed training may have another viewer
                callback.load_state_dict(state["callbacks"][name])
        torch.set_rng_state(state["torch"])


def _refuse_other_spaces(earlier: EnvBase, env: EnvBase, spaces: Spaces) -> None:
    """Refuse worlds of an earlier game that agents made for `env` could not play in."""
    check_env(earlier, env.batch_size.numel())
    if spaces_of(earlier) != spaces:
        raise ValueError(f"earlier has worlds of {spaces_of(earlier)}; allowed: {spaces}, as in env")


def _cut(batch: TensorDictBase) -> TensorDictBase:
    """Return a turn with which all running episodes end as by a time limit."""
    cut = batch.copy()
    after = cut["next"].copy()
    after[keys.DONE] = torch.ones_like(after[keys.DONE])
    after[keys.TRUNCATED] = after[keys.TRUNCATED] | ~after[keys.TERMINATED]
    return cut.set("next", after)


def _changes_between(before: EnvBase, now: EnvBase) -> str:
    """Return in words what differs between the games of two environments."""
    game_before = commons_game_of(before)
    game = commons_game_of(now)
    if game_before is None or game is None:
        return "another game"
    changes = describe_changes(to_config(game_before), to_config(game), "game")
    return "; ".join(changes) or "the same game"


def _states(parts: Sequence[Any]) -> list[dict[str, Any]]:
    return [dict(part.state_dict()) for part in parts]


def train(
    env: EnvBase,
    learners: Mapping[tuple[int, ...], Learner],
    schedule: Schedule,
    *,
    others: Mapping[ActorAgents, nn.Module] | None = None,
    decisions: Decider | None = None,
    governor: Governing | None = None,
    callbacks: Sequence[Any] = (),
    metrics: Sequence[Custom] = (),
    make_collector: MakeCollector = StepCollector,
    earlier: Sequence[tuple[EnvBase, int]] = (),
    checkpointer: Checkpointer | None = None,
) -> Training:
    """Train learners for the length of a schedule: in each turn they act, store the turn and update.

    Args:
        checkpointer: restores the state of the training, and saves it now and then. For the others see
            `Training`.

    Returns:
        The `Training`, which is over.

    Raises:
        NotFiniteError: if a number is not finite, before a checkpoint holds it.
    """
    training = Training(
        env,
        learners,
        schedule,
        others=others,
        decisions=decisions,
        governor=governor,
        callbacks=callbacks,
        metrics=metrics,
        make_collector=make_collector,
        earlier=earlier,
    )
    training.run(checkpointer)
    return training


class Callback(Protocol):
    """The methods that a training calls, each of which may be missing.

    With `state_dict` and `load_state_dict` its state is part of the training's checkpoints.
    """

    def on_start(self, training: Any) -> None:
        """Prepare for a `Training` that takes its first step next, or the first after a checkpoint."""

    def on_step(self, batch: TensorDictBase) -> None:
        """Get a turn of every world, as the collector yields it, [B]."""

    def on_game(self, env: EnvBase, changes: str) -> None:
        """Get the worlds of the next game, before its first turn, with what differs in words; see
        `Experiment.earlier`."""

    def on_ended(self, ended: Sequence[tuple[Episode, dict[str, float]]]) -> None:
        """Get all episodes that have ended in one turn, with their numbers of learning, before `on_episode`
        gets each."""

    def on_episode(self, episode: Episode, learning: dict[str, float]) -> None:
        """Get an episode that has ended, with its numbers of learning: `agent_0/loss`, `agent_0/epsilon`, ...

        A number that is added to `learning` under a new name is logged like the others by loggers, the viewer
        and later callbacks.
        """

    def on_numbers(self, episode: int, numbers: dict[str, Float64]) -> None:
        """Get the numbers of an episode, counted from 0, that all replicas have ended, [R] by name, NaN if
        undefined.

        With W worlds these are means over W episodes, of which `episode` is the last.

        Numbers of the whole training, `time/env_steps` and `time/env_steps_per_s`, have length 1.
        """

    def on_finished(self, run: Path) -> None:
        """Get the directory of a finished run, after everything is written; only `cprl.run` calls it."""


HOOKS: Final = tuple(name for name in vars(Callback) if name.startswith("on_"))
"""The names of the methods of a callback."""


def check_callbacks(callbacks: Sequence[Any]) -> None:
    """Refuse a callback without any of the methods that a training calls."""
    for callback in callbacks:
        if not any(hasattr(callback, hook) for hook in HOOKS):
            raise ValueError(
                f"the callback {short_repr(callback)} has none of the methods {', '.join(HOOKS)}: nothing "
                "would call it"
            )
