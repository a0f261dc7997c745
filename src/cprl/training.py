"""The loop: act, store, learn, measure, record."""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.collectors import BaseCollector

from cprl.collectors import StepCollector
from cprl.envs.commons_env import CommonsEnv
from cprl.learners.base import LaneLosses, Learner, seated
from cprl.learners.single import DQNLearner
from cprl.measuring.episodes import Episode, EpisodeTracker
from cprl.policies.assignment import AgentIndices, AgentPolicies, agent_indices


class Keeper(Protocol):
    """Who keeps the state of a training, as `cprl.recording.Checkpointer` does."""

    def restore(self, training: "Training") -> None:
        """Puts a new training where the last one was."""

    def after_step(self, training: "Training") -> None:
        """Keeps the state, if it is time to."""


MakeCollector = Callable[[CommonsEnv, torch.nn.Module], BaseCollector]
"""A collector out of an environment and a policy; it yields batches [R], or [R, T] of T turns."""


class Callback(Protocol):
    """Whoever wants to know what happens in a training: a table, a recording, a progress bar."""

    def on_step(self, batch: TensorDictBase) -> None:
        """One turn of every world, as the collector yields it, [B]."""

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        """An episode that ended, and how learning went in it: `agent_0/loss`, `agent_0/epsilon`, ..."""


class Training:
    """A training that takes one step after the other, and whose whole state can be read and set.

    All replicas take each step together. One whose episodes are short goes on until the last has played
    its last; what it plays beyond `episodes` is not told to observers.

    Args:
        env: a world for each replica.
        learners: by where they sit: a `DQNLearner` at an agent's number, alone in one replica, or a
            `ReplayLearner` at a tuple of numbers, in every replica.
        episodes: how many to play, at least 1.
        others: the actors of the agents that do not learn, likewise.
        callbacks: told of each turn and each episode, in this order.
        update_every: steps k after which each learner learns, then k times.
        make_collector: `StepCollector`, or for TorchRL's own `cprl.collectors.stock_collector`.

    Raises:
        ValueError: for seats that are empty or taken twice, another number of worlds than the learners
            have replicas, or numbers below 1.
    """

    def __init__(
        self,
        env: CommonsEnv,
        learners: Mapping[AgentIndices, Learner | DQNLearner],
        *,
        episodes: int,
        others: Mapping[AgentIndices, torch.nn.Module] | None = None,
        callbacks: Sequence[Callback] = (),
        update_every: int = 1,
        make_collector: MakeCollector = StepCollector,
    ) -> None:
        self.env, self.episodes, self.callbacks = env, episodes, callbacks
        self.update_every = update_every
        self.others = dict(others or {})
        self.learners = {agents: seated(learner, agents) for agents, learner in learners.items()}
        _check(env, self.learners, self.others)
        for name, number in (("episodes", episodes), ("update_every", update_every)):
            if number < 1:
                raise ValueError(f"{name} is {number}; at least 1 is wanted")
        for learner in self.learners.values():
            steps = getattr(learner, "rollout_steps", update_every)
            if steps % update_every:
                raise ValueError(f"learn_every is {update_every}; it must divide the rollouts' {steps} steps")
        replicas = env.batch_size.numel()
        actors = {agents: learner.actor for agents, learner in self.learners.items()}
        self._collector = make_collector(env, AgentPolicies({**actors, **self.others}))
        self._turns = iter(self._collector)
        self._tracker = EpisodeTracker(replicas, env.game.agents, env.game.rules.episode_steps)
        self._losses = {agents: LaneLosses(replicas, agent_indices(agents)) for agents in self.learners}
        self._played = [0] * replicas
        self.steps = 0
        self._began, self._spent_s = time.monotonic(), 0.0

    @property
    def is_over(self) -> bool:
        """Whether every replica has played its episodes."""
        return min(self._played) >= self.episodes

    @property
    def spent_s(self) -> float:
        """Seconds that it has taken so far, those before it was stopped included."""
        return self._spent_s + time.monotonic() - self._began

    def step(self) -> None:
        """The turns that the collector yields, one as a rule: act, store, learn, measure, record."""
        batch = next(self._turns)
        for turn in [batch] if batch.batch_dims == 1 else batch.unbind(1):
            self._take(turn)

    def _take(self, batch: TensorDictBase) -> None:
        """One turn of every replica."""
        self.steps += 1
        for learner in self.learners.values():
            learner.store(batch)
        if self.steps % self.update_every == 0:
            for _ in range(self.update_every):
                for agents, learner in self.learners.items():
                    self._losses[agents].add(learner.update())
        for callback in self.callbacks:
            callback.on_step(batch)
        ended = self._tracker.add(batch)
        if ended:
            self._end(ended, batch)

    def _end(self, ended: Sequence[Episode], batch: TensorDictBase) -> None:
        worlds = torch.zeros(len(self._played), dtype=torch.bool)
        worlds[[episode.world for episode in ended]] = True
        values = {agents: learner.values(batch) for agents, learner in self.learners.items()}
        learning = [_learning(episode.world, self.learners, self._losses, values) for episode in ended]
        for learner in self.learners.values():
            learner.end_episode(worlds)
        for episode, of_agents in zip(ended, learning, strict=True):
            self._played[episode.world] += 1
            if self._played[episode.world] <= self.episodes:
                for callback in self.callbacks:
                    callback.on_episode(episode, of_agents)

    def state_dict(self) -> dict[str, Any]:
        """Everything that the future depends on, in tensors, numbers, lists and dicts; not copies.

        Raises:
            ValueError: where a learner or the collector keeps no state to go on from.
        """
        self._step_collector()
        return {
            "steps": self.steps,
            "spent_s": self.spent_s,
            "played": list(self._played),
            "worlds": {name: _tensor(array) for name, array in self.env.worlds.state().items()},
            "learners": [learner.state_dict() for learner in self.learners.values()],
            "others": [dict(other.state_dict()) for other in self.others.values()],
            "losses": [losses.state_dict() for losses in self._losses.values()],
            "tracker": self._tracker.state_dict(),
            "observers": {name: own.state_dict() for name, own in self._keeping().items()},
            "torch": torch.get_rng_state(),
        }

    def _keeping(self) -> dict[str, Any]:
        """The observers that go on from a state, as a table does, by the name of their class."""
        return {type(own).__name__: own for own in self.callbacks if hasattr(own, "load_state_dict")}

    def _step_collector(self) -> StepCollector:
        """The collector, if a training can go on with it."""
        if not isinstance(self._collector, StepCollector):
            kind = type(self._collector).__name__
            raise ValueError(
                f"a {kind} keeps no state to go on from; train with a StepCollector, or without checkpoints"
            )
        return self._collector

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes on exactly where the training of that state was, which was made with the same arguments."""
        self._began, self._spent_s = time.monotonic(), float(state["spent_s"])
        self.steps, self._played = int(state["steps"]), list(state["played"])
        kinds = {name: array.dtype for name, array in self.env.worlds.state().items()}
        worlds = {name: tensor.numpy().view(kinds[name]) for name, tensor in state["worlds"].items()}
        self._step_collector().resume_from(self.env.load(worlds))
        for learner, own in zip(self.learners.values(), state["learners"], strict=True):
            learner.load_state_dict(own)
        for other, own in zip(self.others.values(), state["others"], strict=True):
            other.load_state_dict(own)
        for losses, own in zip(self._losses.values(), state["losses"], strict=True):
            losses.load_state_dict(own)
        self._tracker.load_state_dict(state["tracker"])
        for name, callback in self._keeping().items():
            if name in state["observers"]:  # one may watch from now on, or no longer
                callback.load_state_dict(state["observers"][name])
        torch.set_rng_state(state["torch"])


def train(
    env: CommonsEnv,
    learners: Mapping[AgentIndices, Learner | DQNLearner],
    *,
    episodes: int,
    others: Mapping[AgentIndices, torch.nn.Module] | None = None,
    callbacks: Sequence[Callback] = (),
    checkpoints: Keeper | None = None,
    update_every: int = 1,
    make_collector: MakeCollector = StepCollector,
) -> Training:
    """Plays so many episodes of every replica; each learner stores every turn and then learns once.

    Args:
        env: see `Training`, also for all that is not said here.
        learners: by where they sit.
        episodes: how many to play.
        others: the actors of the agents that do not learn.
        callbacks: told of each turn and each episode.
        checkpoints: where the training goes on from, and keeps its state now and then.
        update_every: steps k after which each learner learns, then k times.
        make_collector: what plays.

    Returns:
        The training, which is over.

    Raises:
        ValueError: see `Training`; with checkpoints also for what keeps no state to go on from.
    """
    training = Training(
        env,
        learners,
        episodes=episodes,
        others=others,
        callbacks=callbacks,
        update_every=update_every,
        make_collector=make_collector,
    )
    if checkpoints is not None:
        training.state_dict()  # what cannot be kept is refused now, not when the first checkpoint is due
        checkpoints.restore(training)
    while not training.is_over:
        training.step()
        if checkpoints is not None:
            checkpoints.after_step(training)
    return training


def _tensor(array: NDArray[Any]) -> Tensor:
    """The same bytes as a tensor; torch keeps unsigned numbers as signed ones."""
    return torch.from_numpy(array.view(np.int64) if array.dtype == np.uint64 else array)


def _learning(
    replica: int,
    learners: Mapping[AgentIndices, Learner],
    losses: Mapping[AgentIndices, LaneLosses],
    values: Mapping[AgentIndices, Tensor],
) -> dict[str, float]:
    """How learning went in the episode of a replica that has just ended."""
    learning = {}
    for agents, learner in learners.items():
        for place, (agent, loss) in enumerate(losses[agents].take(replica).items()):
            learning[f"agent_{agent}/loss"] = loss
            learning[f"agent_{agent}/epsilon"] = learner.actor.epsilon
            learning[f"agent_{agent}/q"] = float(values[agents][replica, place])
    return learning


def _check(
    env: CommonsEnv,
    learners: Mapping[AgentIndices, Learner],
    others: Mapping[AgentIndices, torch.nn.Module],
) -> None:
    taken = sorted(agent for agents in [*learners, *others] for agent in agent_indices(agents))
    wanted = list(range(env.game.agents))
    if taken != wanted:
        raise ValueError(f"learners and others sit at {taken}; the game has the seats {wanted}, each for one")
    worlds = env.batch_size.numel()
    for agents, learner in learners.items():
        if learner.agents != agent_indices(agents):
            raise ValueError(f"a learner made for the seats {learner.agents} sits at {agent_indices(agents)}")
        if learner.replicas != worlds:
            raise ValueError(
                f"the environment has {worlds} worlds; the learner at {agents} has "
                f"{learner.replicas} replicas"
            )
