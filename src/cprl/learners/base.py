"""Who learns: what the training loop wants of a learner, and a plain agent as one."""

from collections.abc import Mapping
from math import nan
from typing import Any, Final, Protocol

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from cprl.learners.single import DQNLearner
from cprl.learners.transitions import seen_next, transitions_of
from cprl.policies.assignment import AgentIndices, agent_indices

_NO_STATE: Final = (
    "a DQNLearner keeps no state to go on from; use a ReplayLearner, or train without checkpoints"
)


class Learner(Protocol):
    """Who learns at some seats of each replica, as `ReplayLearner` does."""

    actor: Any
    """Chooses at these seats; its `epsilon` is told to observers."""
    agents: tuple[int, ...]
    replicas: int

    def store(self, batch: TensorDictBase) -> None:
        """Stores a turn of every replica."""

    def update(self) -> Tensor | None:
        """One update; losses [R, S], or None while too little is stored."""

    def end_episode(self, ended: Tensor) -> None:
        """An episode of the marked replicas has ended, bool [R]."""

    def values(self, batch: TensorDictBase) -> Tensor:
        """What each agent expects at best from the turn's end on, [R, S]; for people to look at."""

    def state_dict(self) -> dict[str, Any]:
        """Everything that its future depends on."""

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes on where the learner of that state was."""


class OneAgent:
    """A plain `DQNLearner` as a `Learner`: one agent of one replica.

    Args:
        learner: the agent.
        agent: its number.
    """

    replicas = 1

    def __init__(self, learner: DQNLearner, agent: int) -> None:
        self.learner, self.actor = learner, learner.actor
        self.agents: tuple[int, ...] = (agent,)

    def store(self, batch: TensorDictBase) -> None:
        """See `Learner`."""
        self.learner.store(transitions_of(self.agents[0], batch))

    def update(self) -> Tensor | None:
        """See `Learner`."""
        loss = self.learner.update()
        return None if loss is None else torch.tensor([[loss]])

    def end_episode(self, ended: Tensor) -> None:
        """See `Learner`."""
        self.learner.end_episode()

    def values(self, batch: TensorDictBase) -> Tensor:
        """See `Learner`."""
        with torch.no_grad():
            highest: Tensor = self.learner.network(seen_next(batch)[:, list(self.agents)]).amax(-1)
        return highest

    def state_dict(self) -> dict[str, Any]:
        """A plain agent cannot go on from a checkpoint; `ReplayLearner` can."""
        raise ValueError(_NO_STATE)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """See `state_dict`."""
        raise ValueError(_NO_STATE)


def seated(learner: Learner | DQNLearner, agent: AgentIndices) -> Learner:
    """What sits there as a `Learner`."""
    if isinstance(learner, DQNLearner):
        return OneAgent(learner, agent_indices(agent)[0])
    return learner


class LaneLosses:
    """The losses of the agents at some seats since each replica's last episode ended.

    Args:
        replicas: how many replicas R.
        agents: their numbers.
    """

    def __init__(self, replicas: int, agents: tuple[int, ...]) -> None:
        self.agents = agents
        self.total = np.zeros((replicas, len(agents)), np.float64)
        self.updates = np.zeros(replicas, np.int64)

    def add(self, loss: Tensor | None) -> None:
        """Takes the losses of an update, [R, S]; None for no update."""
        if loss is not None:
            self.total += loss.numpy(force=True)
            self.updates += 1

    def take(self, replica: int) -> dict[int, float]:
        """The mean loss of each agent of a replica, NaN before its first update; starts it anew."""
        updates = self.updates[replica]
        means = (self.total[replica] / updates).tolist() if updates else [nan] * len(self.agents)
        self.total[replica], self.updates[replica] = 0.0, 0
        return dict(zip(self.agents, means, strict=True))

    def state_dict(self) -> dict[str, Tensor]:
        """What was summed so far."""
        return {"total": torch.tensor(self.total), "updates": torch.tensor(self.updates)}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Goes on with the sums of that state."""
        self.total[:], self.updates[:] = state["total"].numpy(), state["updates"].numpy()
