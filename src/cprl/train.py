"""The loop: act, store, learn, measure, record."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector

from cprl.acting.seats import Seats
from cprl.envs.torchrl_env import CommonsEnv
from cprl.learning.dqn import DQNLearner
from cprl.learning.transitions import transitions_of
from cprl.measuring.episodes import Episode, EpisodeTracker


class Observer(Protocol):
    """Whoever wants to know what happens in a training: a table, a recording, a progress bar."""

    def see_turn(self, batch: TensorDictBase) -> None:
        """One turn of every world, as the collector yields it, [B, 1]."""

    def see_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        """An episode that ended, and how learning went in it: `agent_0/loss`, `agent_0/epsilon`, ..."""


@dataclass
class _Losses:
    """The losses of one agent since the last episode ended."""

    total: float = 0.0
    updates: int = 0

    def add(self, loss: float | None) -> None:
        if loss is not None:
            self.total += loss
            self.updates += 1

    def mean(self) -> float:
        return self.total / self.updates if self.updates else float("nan")


@dataclass
class _Progress:
    """What the loop counts."""

    losses: dict[int, _Losses] = field(default_factory=dict)
    episodes: int = 0


def train(
    env: CommonsEnv,
    learners: Mapping[int, DQNLearner],
    *,
    episodes: int,
    others: Mapping[int, torch.nn.Module] | None = None,
    observers: Sequence[Observer] = (),
) -> None:
    """Plays so many episodes; each learner stores every turn of its agent and then learns once.

    Args:
        env: one world (more come with replicas).
        learners: by the number of the agent that learns.
        episodes: how many to play, at least 1.
        others: the actors of the agents that do not learn.
        observers: told of each turn and each episode, in this order.

    Raises:
        ValueError: for seats that are empty or taken twice, more than one world, or no episodes.
    """
    others = others or {}
    _check(env, learners, others, episodes)
    actors: dict[int, torch.nn.Module] = {agent: learner.actor for agent, learner in learners.items()}
    actors |= others
    collector = Collector(
        env,
        Seats([actors[agent] for agent in range(env.game.agents)]),
        frames_per_batch=env.batch_size.numel(),
        total_frames=-1,
        track_traj_ids=False,
        auto_register_policy_transforms=False,
    )
    tracker = EpisodeTracker(env.batch_size.numel(), env.game.agents, env.game.rules.episode_steps)
    progress = _Progress(losses={agent: _Losses() for agent in learners})
    try:
        for batch in collector:
            for agent, learner in learners.items():
                learner.remember(transitions_of(agent, batch))
                progress.losses[agent].add(learner.learn())
            for observer in observers:
                observer.see_turn(batch)
            for episode in tracker.add(batch):
                _end_episode(episode, learners, progress, observers)
            if progress.episodes >= episodes:
                break
    finally:
        collector.shutdown(close_env=False)


def _end_episode(
    episode: Episode,
    learners: Mapping[int, DQNLearner],
    progress: _Progress,
    observers: Sequence[Observer],
) -> None:
    learning = {}
    for agent, learner in learners.items():
        learning[f"agent_{agent}/loss"] = progress.losses[agent].mean()
        learning[f"agent_{agent}/epsilon"] = learner.actor.epsilon
        progress.losses[agent] = _Losses()
        learner.end_episode()
    progress.episodes += 1
    for observer in observers:
        observer.see_episode(episode, learning)


def _check(
    env: CommonsEnv,
    learners: Mapping[int, DQNLearner],
    others: Mapping[int, torch.nn.Module],
    episodes: int,
) -> None:
    taken, wanted = sorted([*learners, *others]), list(range(env.game.agents))
    if taken != wanted:
        raise ValueError(f"learners and others sit at {taken}; the game has the seats {wanted}, each for one")
    if env.batch_size.numel() != 1:
        raise ValueError(f"the environment has {env.batch_size.numel()} worlds; training takes one")
    if episodes < 1:
        raise ValueError(f"episodes is {episodes}; at least 1 is wanted")
