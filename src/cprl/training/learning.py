"""What a training keeps of its learners, episode by episode, and whom it accepts."""

from collections.abc import Mapping
from math import nan
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from cprl.learners.base import Learner
from cprl.policies.assignment import AgentIndices, agent_indices
from cprl.policies.decisions import Decider
from cprl.values import Positive, checked

Learners: TypeAlias = Mapping[tuple[int, ...], Learner]
"""By the indices of their agents."""


class LaneLosses:
    """Mean losses of S agents since the end of each replica's last episode."""

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
        means = self.total[replica] / (self.updates[replica] or nan)
        self.total[replica], self.updates[replica] = 0.0, 0
        return dict(zip(self.agents, means.tolist(), strict=True))

    def state_dict(self) -> dict[str, Tensor]:
        return {"total": torch.tensor(self.total), "updates": torch.tensor(self.updates)}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        self.total[:], self.updates[:] = state["total"].numpy(), state["updates"].numpy()


class WantedReturns:
    """The sums of the rewards that agents want, over the running episode of each replica.

    Args:
        agents: the number of agents N; those that do not learn have NaN.
    """

    def __init__(self, replicas: int, agents: int, learners: Learners) -> None:
        self._wants: list[tuple[Any, Any]] = []
        self._first = np.full(agents, nan)
        for indices, learner in learners.items():
            learner.wants.clear()
            self._wants.append((slice(None) if len(indices) == agents else list(indices), learner.wants))
            self._first[list(indices)] = 0
        self.returns = np.tile(self._first, (replicas, 1))

    def add(self) -> None:
        """Adds the turn that the learners have just stored."""
        for columns, wants in self._wants:
            turn = wants.now
            turn = turn.numpy(force=True) if isinstance(turn, Tensor) else turn
            self.returns[:, columns] += turn[:, columns]

    def take(self, replica: int) -> NDArray[np.float64]:
        """The wanted return of each agent of a replica, [N], whose next episode begins at 0."""
        taken: NDArray[np.float64] = self.returns[replica].copy()
        self.returns[replica] = self._first
        return taken

    def state_dict(self) -> dict[str, Tensor]:
        return {"returns": torch.tensor(self.returns)}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        self.returns[:] = state["returns"].numpy()


def learned_in(
    replica: int,
    learners: Learners,
    losses: Mapping[tuple[int, ...], LaneLosses],
    values: Mapping[tuple[int, ...], Tensor],
) -> dict[str, float]:
    """What was learned in the episode of a replica that has just ended."""
    learning = {}
    for agents, learner in learners.items():
        for place, (agent, loss) in enumerate(losses[agents].take(replica).items()):
            learning[f"agent_{agent}/loss"] = loss
            learning[f"agent_{agent}/epsilon"] = learner.actor.epsilon
            learning[f"agent_{agent}/q"] = float(values[agents][replica, place])
    return learning


def check_agents(
    agents: int, replicas: int, learners: Learners, others: Mapping[AgentIndices, nn.Module]
) -> None:
    """Raises a ValueError unless each of N agents has one learner or actor, with R replicas."""
    taken = sorted(agent for indices in [*learners, *others] for agent in agent_indices(indices))
    if taken != (wanted := list(range(agents))):
        raise ValueError(
            f"learners and others control the agents {taken}; allowed: each of {wanted} exactly once"
        )
    for indices, learner in learners.items():
        if learner.agents != agent_indices(indices):
            raise ValueError(f"a learner made for the agents {learner.agents} is given for {indices}")
        if learner.replicas != replicas:
            raise ValueError(
                f"the environment has {replicas} worlds; the learner of {indices} has {learner.replicas} "
                "replicas; allowed: a world for each replica"
            )


def check_decisions(decisions: Decider | None, options: int) -> None:
    """Raises a ValueError unless there is a Decider where agents have so many options, and none for 0."""
    if bool(options) != (decisions is not None):
        asks, allowed = ("vote or elect", "a Decider, e.g. Population(...).decisions")
        if not options:
            asks, allowed = "decide nothing", "None"
        raise ValueError(
            f"decisions is {decisions and 'a Decider'}; allowed for a game whose agents {asks}: {allowed}"
        )


def check_numbers(episodes: int, update_every: int, learners: Learners) -> None:
    """Raises a ValueError for numbers below 1, and for rollouts that `update_every` does not divide."""
    for name, number in (("episodes", episodes), ("update_every", update_every)):
        checked(name, number, Positive)
    for learner in learners.values():
        steps = getattr(learner, "rollout_steps", update_every)
        if steps % update_every:
            raise ValueError(f"update_every is {update_every}; allowed: a divisor of rollout_steps {steps}")
