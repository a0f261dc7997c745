"""The loop: act, store, learn, measure, record."""

import logging
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor

from cprl.acting.collect import StepCollector
from cprl.acting.seats import Seat, Seats, agents_at
from cprl.envs.torchrl_env import CommonsEnv
from cprl.learning.dqn import DQNLearner
from cprl.learning.transitions import transitions_of
from cprl.measuring.episodes import Episode, EpisodeTracker


class Learner(Protocol):
    """Who learns at some seats of each replica, as `LaneLearner` does."""

    actor: Any
    """Chooses at these seats; its `epsilon` is told to observers."""
    seats: tuple[int, ...]
    replicas: int

    def remember(self, batch: TensorDictBase) -> None:
        """Stores a turn of every replica."""

    def learn(self) -> Tensor | None:
        """One update; losses [R, S], or None while too little is stored."""

    def end_episode(self, ended: Tensor) -> None:
        """An episode of the marked replicas has ended, bool [R]."""


class OneAgent:
    """A plain `DQNLearner` as a `Learner`: one agent of one replica.

    Args:
        learner: the agent.
        agent: its number.
    """

    replicas = 1

    def __init__(self, learner: DQNLearner, agent: int) -> None:
        self.learner, self.actor = learner, learner.actor
        self.seats: tuple[int, ...] = (agent,)

    def remember(self, batch: TensorDictBase) -> None:
        """See `Learner`."""
        self.learner.remember(transitions_of(self.seats[0], batch))

    def learn(self) -> Tensor | None:
        """See `Learner`."""
        loss = self.learner.learn()
        return None if loss is None else torch.tensor([[loss]])

    def end_episode(self, ended: Tensor) -> None:
        """See `Learner`."""
        self.learner.end_episode()


class Observer(Protocol):
    """Whoever wants to know what happens in a training: a table, a recording, a progress bar."""

    def see_turn(self, batch: TensorDictBase) -> None:
        """One turn of every world, as the collector yields it, [B]."""

    def see_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        """An episode that ended, and how learning went in it: `agent_0/loss`, `agent_0/epsilon`, ..."""


class _Losses:
    """The losses of the agents at some seats since each replica's last episode ended."""

    def __init__(self, replicas: int, agents: tuple[int, ...]) -> None:
        self.agents = agents
        self.total = torch.zeros((replicas, len(agents)), dtype=torch.float64)
        self.updates = torch.zeros(replicas, dtype=torch.int64)

    def add(self, loss: Tensor | None) -> None:
        if loss is not None:
            self.total += loss.cpu()
            self.updates += 1

    def take(self, replica: int) -> dict[int, float]:
        """The mean loss of each agent of a replica, NaN before its first update; starts it anew."""
        means = (self.total[replica] / self.updates[replica]).tolist()
        self.total[replica], self.updates[replica] = 0.0, 0
        return dict(zip(self.agents, means, strict=True))


def prepare_process(seed: int) -> None:
    """What a training wants of torch: one thread, no denormals, its generator seeded, TorchRL's log quiet.

    These networks are so small that a second thread costs more than it gives, up to a hundredfold on a busy
    machine; denormal numbers in Adam's moments of dead weights slow a long run by up to 1.9 times.
    """
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    logging.getLogger("torchrl").setLevel(logging.WARNING)


def train(
    env: CommonsEnv,
    learners: Mapping[Seat, Learner | DQNLearner],
    *,
    episodes: int,
    others: Mapping[Seat, torch.nn.Module] | None = None,
    observers: Sequence[Observer] = (),
) -> None:
    """Plays so many episodes of every replica; each learner stores every turn and then learns once.

    All replicas take each step together. One whose episodes are short goes on until the last has played
    its last; what it plays beyond `episodes` is not told to observers.

    Args:
        env: a world for each replica.
        learners: by where they sit: a `DQNLearner` at an agent's number, alone in one replica, or a
            `LaneLearner` at a tuple of numbers, in every replica.
        episodes: how many to play, at least 1.
        others: the actors of the agents that do not learn, likewise.
        observers: told of each turn and each episode, in this order.

    Raises:
        ValueError: for seats that are empty or taken twice, another number of worlds than the learners
            have replicas, or no episodes.
    """
    others = others or {}
    seated = {seat: _seated(learner, seat) for seat, learner in learners.items()}
    _check(env, seated, others, episodes)
    replicas = env.batch_size.numel()
    actors = {seat: learner.actor for seat, learner in seated.items()}
    collector = StepCollector(env, Seats({**actors, **others}))
    tracker = EpisodeTracker(replicas, env.game.agents, env.game.rules.episode_steps)
    losses = {seat: _Losses(replicas, agents_at(seat)) for seat in seated}
    played = [0] * replicas
    try:
        for batch in collector:
            for seat, learner in seated.items():
                learner.remember(batch)
                losses[seat].add(learner.learn())
            for observer in observers:
                observer.see_turn(batch)
            ended = tracker.add(batch)
            if not ended:
                continue
            worlds = torch.zeros(replicas, dtype=torch.bool)
            worlds[[episode.world for episode in ended]] = True
            learning = [_learning(episode.world, seated, losses) for episode in ended]
            for learner in seated.values():
                learner.end_episode(worlds)
            for episode, of_agents in zip(ended, learning, strict=True):
                played[episode.world] += 1
                if played[episode.world] <= episodes:
                    for observer in observers:
                        observer.see_episode(episode, of_agents)
            if min(played) >= episodes:
                break
    finally:
        collector.shutdown(close_env=False)


def _seated(learner: Learner | DQNLearner, seat: Seat) -> Learner:
    if isinstance(learner, DQNLearner):
        return OneAgent(learner, agents_at(seat)[0])
    return learner


def _learning(
    replica: int, learners: Mapping[Seat, Learner], losses: Mapping[Seat, _Losses]
) -> dict[str, float]:
    """How learning went in the episode of a replica that has just ended."""
    learning = {}
    for seat, learner in learners.items():
        for agent, loss in losses[seat].take(replica).items():
            learning[f"agent_{agent}/loss"] = loss
            learning[f"agent_{agent}/epsilon"] = learner.actor.epsilon
    return learning


def _check(
    env: CommonsEnv,
    learners: Mapping[Seat, Learner],
    others: Mapping[Seat, torch.nn.Module],
    episodes: int,
) -> None:
    taken = sorted(agent for seat in [*learners, *others] for agent in agents_at(seat))
    wanted = list(range(env.game.agents))
    if taken != wanted:
        raise ValueError(f"learners and others sit at {taken}; the game has the seats {wanted}, each for one")
    worlds = env.batch_size.numel()
    for seat, learner in learners.items():
        if learner.seats != agents_at(seat):
            raise ValueError(f"a learner made for the seats {learner.seats} sits at {agents_at(seat)}")
        if learner.replicas != worlds:
            raise ValueError(
                f"the environment has {worlds} worlds; the learner at {seat} has {learner.replicas} replicas"
            )
    if episodes < 1:
        raise ValueError(f"episodes is {episodes}; at least 1 is wanted")
