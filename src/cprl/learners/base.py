"""The interface between the training loop and a learner."""

from collections.abc import Mapping
from math import nan
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor, nn

from cprl.learners.preferences import WantedRewards
from cprl.policies.assignment import AgentIndices, agent_indices
from cprl.policies.decisions import Decider
from cprl.values import Positive, checked


class Learner(Protocol):
    """Learns for S agents of each of R replicas; `ReplayLearner` is one."""

    actor: Any
    """Chooses the actions of these agents; callbacks get its `epsilon`."""
    agents: tuple[int, ...]
    """The indices of the agents."""
    replicas: int
    """The number of replicas R."""
    settings: Any
    """The hyperparameters.

    A learner may also have `wants`, a `cprl.learners.preferences.WantedRewards`: what its agents want. And
    `begin()`, which a training calls before its first turn: whatever the learner has stored of an earlier
    training, the next turn begins new episodes.
    """

    def store(self, batch: TensorDictBase) -> None:
        """Stores one step of every replica; the batch size is [R]."""

    def update(self) -> Tensor | None:
        """Updates every agent once; returns the losses [R, S], or None if too little is stored."""

    def end_episode(self, ended: Tensor) -> None:
        """Called after an episode has ended in the marked replicas, bool [R]."""

    def values(self, batch: TensorDictBase) -> Tensor:
        """Each agent's estimate of the value of the state after the turn, [R, S]; for display only."""

    def finite(self) -> Tensor:
        """Whether everything that the learner keeps of each agent is finite, above all weights and targets,
        bool [R, S]; called at the end of episodes and before the state is saved."""

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
        updates = self.updates[replica]
        means = (self.total[replica] / updates).tolist() if updates else [nan] * len(self.agents)
        self.total[replica], self.updates[replica] = 0.0, 0
        return dict(zip(self.agents, means, strict=True))

    def state_dict(self) -> dict[str, Tensor]:
        return {"total": torch.tensor(self.total), "updates": torch.tensor(self.updates)}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        self.total[:], self.updates[:] = state["total"].numpy(), state["updates"].numpy()


class WantedReturns:
    """The sums of the rewards that agents want, over the running episode of each replica.

    Args:
        agents: the number of agents N; those that do not learn, or whose learner does not say what they want,
            have NaN.
    """

    def __init__(self, replicas: int, agents: int, learners: Mapping[tuple[int, ...], Learner]) -> None:
        self._wants: list[tuple[Any, WantedRewards]] = []
        self._first = np.full(agents, nan)
        for indices, learner in learners.items():
            wants = getattr(learner, "wants", None)
            if isinstance(wants, WantedRewards):
                wants.clear()
                self._wants.append((slice(None) if len(indices) == agents else list(indices), wants))
                self._first[list(indices)] = 0
        self.returns = np.tile(self._first, (replicas, 1))

    def add(self) -> None:
        """Adds the turn that the learners have just stored."""
        for columns, wants in self._wants:
            turn: Any = wants.now
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
    learners: Mapping[tuple[int, ...], Learner],
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
    agents: int,
    replicas: int,
    learners: Mapping[tuple[int, ...], Learner],
    others: Mapping[AgentIndices, nn.Module],
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
    if options and decisions is None:
        raise ValueError(
            "decisions is None; allowed for a game whose agents vote or elect: a Decider, e.g. "
            "Population(...).decisions"
        )
    if decisions is not None and not options:
        raise ValueError("decisions is a Decider; allowed for a game whose agents decide nothing: None")


def check_numbers(episodes: int, update_every: int, learners: Mapping[tuple[int, ...], Learner]) -> None:
    """Raises a ValueError for numbers below 1, and for rollouts that `update_every` does not divide."""
    for name, number in (("episodes", episodes), ("update_every", update_every)):
        checked(name, number, Positive)
    for learner in learners.values():
        steps = getattr(learner, "rollout_steps", update_every)
        if steps % update_every:
            raise ValueError(f"update_every is {update_every}; allowed: a divisor of rollout_steps {steps}")
