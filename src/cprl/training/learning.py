"""What a training keeps of its learners in each episode, and checks of its learners and decisions."""

from collections.abc import Mapping, Sequence
from math import nan
from typing import Any, TypeAlias

import numpy as np
import torch
from torch import Tensor
from torchrl.envs import EnvBase

from cprl.commons.game import Game
from cprl.keys import Turn
from cprl.learners.learner import Learner
from cprl.policies.decisions import Decider
from cprl.values.array_types import Float64

Learners: TypeAlias = Mapping[tuple[int, ...], Learner]
"""Learners, by the indices of their agents."""


class LaneLosses:
    """The mean losses of S agents since the end of each replica's last episode."""

    def __init__(self, replicas: int, agents: tuple[int, ...]) -> None:
        self.total = np.zeros((replicas, len(agents)), np.float64)
        self.updates = np.zeros(replicas, np.int64)

    def add(self, loss: Tensor | None) -> None:
        """Add the losses of an update, [R, S]; None if there was no update."""
        if loss is not None:
            self.total += loss.numpy(force=True)
            self.updates += 1

    def take(self, replica: int) -> list[float]:
        """Return the mean loss of each agent of a replica, NaN without an update, and reset the replica."""
        means: list[float] = (self.total[replica] / (self.updates[replica] or nan)).tolist()
        self.total[replica] = 0.0
        self.updates[replica] = 0
        return means

    def state_dict(self) -> dict[str, Tensor]:
        return {"total": torch.tensor(self.total), "updates": torch.tensor(self.updates)}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        self.total[:] = state["total"].numpy()
        self.updates[:] = state["updates"].numpy()


class ShapedReturns:
    """The shaped returns of the running episode of each world: sums of the rewards that agents learn from.

    Args:
        worlds: the worlds of all replicas, B.
        agents: the number of agents N; those that do not learn have NaN.
    """

    def __init__(self, worlds: int, agents: int, learners: Learners) -> None:
        self._rewards: list[tuple[Any, Any]] = []
        self._first = np.full(agents, nan)
        for indices, learner in learners.items():
            learner.rewards.clear()
            columns = slice(None) if len(indices) == agents else list(indices)
            self._rewards.append((columns, learner.rewards))
            self._first[list(indices)] = 0
        self.returns = np.tile(self._first, (worlds, 1))

    def add(self) -> None:
        """Add the rewards of the turn that the learners have just stored."""
        for columns, rewards in self._rewards:
            turn = rewards.latest
            turn = turn.numpy(force=True) if isinstance(turn, Tensor) else turn
            self.returns[:, columns] += turn[:, columns]

    def take(self, world: int) -> Float64:
        """Return the shaped return of each agent of a world, [N], and reset it to 0."""
        returns: Float64 = self.returns[world].copy()
        self.returns[world] = self._first
        return returns

    def state_dict(self) -> dict[str, Tensor]:
        return {"returns": torch.tensor(self.returns)}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        self.returns[:] = state["returns"].numpy()


def learning_numbers(
    ended: Sequence[int],
    turn: Turn,
    learners: Learners,
    losses: Mapping[tuple[int, ...], LaneLosses],
    worlds: int,
) -> list[dict[str, float]]:
    """Return the numbers of learning of the episodes that have just ended, by agent: "loss", the mean since
    the replica's last episode, which is reset; "epsilon"; and "q", the value of the state.

    Args:
        ended: the worlds in which they ended, each once.
        turn: their last turn.
        worlds: the worlds W of each replica.
    """
    by_episode: list[dict[str, float]] = [{} for _ in ended]
    replicas = {world // worlds for world in ended}
    for agents, learner in learners.items():
        means = {replica: losses[agents].take(replica) for replica in replicas}
        values = learner.values(turn).tolist()
        for world, numbers in zip(ended, by_episode, strict=True):
            for agent, loss, value in zip(agents, means[world // worlds], values[world], strict=True):
                numbers[f"agent_{agent}/loss"] = loss
                numbers[f"agent_{agent}/epsilon"] = learner.actor.epsilon
                numbers[f"agent_{agent}/q"] = value
    return by_episode


def check_learners(env: EnvBase, worlds: int, learners: Learners) -> int:
    """Return the number of replicas R; raise a ValueError unless all learners are made for them, and for W
    worlds of each."""
    all_worlds: int = env.batch_size.numel()
    if all_worlds % worlds:
        raise ValueError(f"worlds is {worlds}; allowed: a divisor of the environment's {all_worlds} worlds")
    replicas = all_worlds // worlds
    for indices, learner in learners.items():
        if learner.agents != indices:
            raise ValueError(f"a learner made for the agents {learner.agents} is given for {indices}")
        if (learner.replicas, learner.worlds) != (replicas, worlds):
            raise ValueError(
                f"the environment has {replicas} replicas of {worlds} worlds; the learner of {indices} has "
                f"{learner.replicas} of {learner.worlds}; allowed: the same"
            )
    return replicas


def check_decisions(decisions: Decider | None, game: Game | None) -> None:
    """Raise a ValueError if agents have options on ballots but no Decider, or a Decider but no options."""
    options = 0 if game is None else game.decisions
    if options and decisions is None:
        raise ValueError(
            "decisions is None; allowed for a game whose agents vote or elect: a Decider, e.g. "
            "Population(...).decisions"
        )
    if decisions is not None and not options:
        raise ValueError("decisions is a Decider; allowed for a game whose agents decide nothing: None")
