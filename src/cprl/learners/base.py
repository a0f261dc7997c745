"""The interface between the training loop and a learner."""

from collections.abc import Mapping
from math import nan
from typing import Any, Protocol

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor, nn


class Learner(Protocol):
    """Learns for S agents of each of R replicas; `ReplayLearner` is one."""

    actor: Any
    """Chooses the actions of these agents; callbacks get its `epsilon`."""
    agents: tuple[int, ...]
    """The indices of the agents."""
    replicas: int
    """The number of replicas R."""
    settings: Any
    """The hyperparameters."""

    def store(self, batch: TensorDictBase) -> None:
        """Stores one step of every replica; the batch size is [R]."""

    def update(self) -> Tensor | None:
        """Updates every agent once; returns the losses [R, S], or None if too little is stored."""

    def end_episode(self, ended: Tensor) -> None:
        """Called after an episode has ended in the marked replicas, bool [R]."""

    def values(self, batch: TensorDictBase) -> Tensor:
        """Each agent's estimate of the value of the state after the turn, [R, S]; for display only."""

    def evaluation_actor(self, worlds: int) -> Any:
        """An actor with the current weights and the exploration of evaluation, for `worlds` worlds of each
        replica."""

    def networks(self) -> dict[str, nn.Module]:
        """A copy of each agent's current acting network, by "replica_0/agent_0" and so on."""

    def state_dict(self) -> dict[str, Any]:
        """The full state: training continues from it exactly."""

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from a state that `state_dict` returned."""


class LaneLosses:
    """Mean losses of S agents since the end of each replica's last episode.

    Args:
        replicas: the number of replicas R.
        agents: the indices of the agents.
    """

    def __init__(self, replicas: int, agents: tuple[int, ...]) -> None:
        self.agents = agents
        self.total = np.zeros((replicas, len(agents)), np.float64)
        self.updates = np.zeros(replicas, np.int64)

    def add(self, loss: Tensor | None) -> None:
        """Adds the losses of an update, [R, S]; None if there was no update."""
        if loss is not None:
            self.total += loss.numpy(force=True)
            self.updates += 1

    def take(self, replica: int) -> dict[int, float]:
        """Returns the mean loss of each agent of a replica, NaN without an update, and resets the replica."""
        updates = self.updates[replica]
        means = (self.total[replica] / updates).tolist() if updates else [nan] * len(self.agents)
        self.total[replica], self.updates[replica] = 0.0, 0
        return dict(zip(self.agents, means, strict=True))

    def state_dict(self) -> dict[str, Tensor]:
        """The sums so far."""
        return {"total": torch.tensor(self.total), "updates": torch.tensor(self.updates)}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Continues from the sums of a state."""
        self.total[:], self.updates[:] = state["total"].numpy(), state["updates"].numpy()
