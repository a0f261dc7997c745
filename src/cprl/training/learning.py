"""What a training keeps of its learners, episode by episode, and whom it accepts."""

from collections.abc import Mapping, Sequence
from math import nan
from typing import Annotated, Any, TypeAlias

import numpy as np
import torch
from torch import Tensor, nn
from torchrl.envs import EnvBase

from cprl.learners.base import Learner
from cprl.policies.assignment import AgentIndices, agent_indices
from cprl.policies.decisions import Decider
from cprl.values import MOST_INT64, Range, checked
from cprl.values.arrays import Float64

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
    """The sums of the rewards that agents want, over the running episode of each world.

    Args:
        worlds: of all replicas, B.
        agents: the number of agents N; those that do not learn have NaN.
    """

    def __init__(self, worlds: int, agents: int, learners: Learners) -> None:
        self._wants: list[tuple[Any, Any]] = []
        self._first = np.full(agents, nan)
        for indices, learner in learners.items():
            learner.wants.clear()
            self._wants.append((slice(None) if len(indices) == agents else list(indices), learner.wants))
            self._first[list(indices)] = 0
        self.returns = np.tile(self._first, (worlds, 1))

    def add(self) -> None:
        """Adds the turn that the learners have just stored."""
        for columns, wants in self._wants:
            turn = wants.now
            turn = turn.numpy(force=True) if isinstance(turn, Tensor) else turn
            self.returns[:, columns] += turn[:, columns]

    def take(self, world: int) -> Float64:
        """The wanted return of each agent of a world, [N], whose next episode begins at 0."""
        taken: Float64 = self.returns[world].copy()
        self.returns[world] = self._first
        return taken

    def state_dict(self) -> dict[str, Tensor]:
        return {"returns": torch.tensor(self.returns)}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        self.returns[:] = state["returns"].numpy()


def losses_of(replica: int, losses: Mapping[tuple[int, ...], LaneLosses]) -> dict[int, float]:
    """The mean loss of each learning agent of a replica since it last ended an episode, then begun anew."""
    return {agent: loss for of_agents in losses.values() for agent, loss in of_agents.take(replica).items()}


def learned_in(
    world: int,
    learners: Learners,
    losses: Mapping[int, float],
    values: Mapping[tuple[int, ...], Sequence[Sequence[float]]],
) -> dict[str, float]:
    """What was learned in the episode of a world that has just ended.

    Args:
        losses: by agent, see `losses_of`.
        values: of the states of all worlds, [B, S].
    """
    learning = {}
    for agents, learner in learners.items():
        for place, agent in enumerate(agents):
            learning[f"agent_{agent}/loss"] = losses[agent]
            learning[f"agent_{agent}/epsilon"] = learner.actor.epsilon
            learning[f"agent_{agent}/q"] = values[agents][world][place]
    return learning


def check_agents(
    env: EnvBase,
    agents: int,
    worlds: int,
    learners: Learners,
    others: Mapping[AgentIndices, nn.Module],
) -> int:
    """Return the number of replicas R; raise a ValueError unless each of N agents has one learner or actor,
    in W worlds of each replica."""
    everywhere: int = env.batch_size.numel()
    replicas, left = divmod(everywhere, worlds)
    if left:
        raise ValueError(f"worlds is {worlds}; allowed: a divisor of the environment's {everywhere} worlds")
    taken = sorted(agent for indices in [*learners, *others] for agent in agent_indices(indices))
    if taken != (wanted := list(range(agents))):
        raise ValueError(
            f"learners and others control the agents {taken}; allowed: each of {wanted} exactly once"
        )
    for indices, learner in learners.items():
        if learner.agents != agent_indices(indices):
            raise ValueError(f"a learner made for the agents {learner.agents} is given for {indices}")
        of_learner = learner.replicas, getattr(learner, "worlds", 1)
        if of_learner != (replicas, worlds):
            raise ValueError(
                f"the environment has {replicas} replicas of {worlds} worlds; the learner of {indices} has "
                f"{of_learner[0]} of {of_learner[1]}; allowed: the same"
            )
    return replicas


def check_decisions(decisions: Decider | None, options: int) -> None:
    """Raises a ValueError unless there is a Decider where agents have so many options, and none for 0."""
    if bool(options) != (decisions is not None):
        asks, allowed = ("vote or elect", "a Decider, e.g. Population(...).decisions")
        if not options:
            asks, allowed = "decide nothing", "None"
        raise ValueError(
            f"decisions is {decisions and 'a Decider'}; allowed for a game whose agents {asks}: {allowed}"
        )


def check_numbers(
    episodes: int | None, steps: int | None, worlds: int, update_every: int, learners: Learners
) -> None:
    """Raises a ValueError for numbers below 1, for none or both of episodes and steps, and for rollouts that
    `update_every` does not divide."""
    if (episodes is None) == (steps is None):
        raise ValueError(f"episodes is {episodes} and steps {steps}; allowed: one of them")
    numbers = {"episodes": episodes, "steps": steps, "worlds": worlds, "update_every": update_every}
    for name, number in numbers.items():
        if number is not None:
            checked(name, number, Annotated[int, Range(1, MOST_INT64)])
    for learner in learners.values():
        steps = getattr(learner, "rollout_steps", update_every)
        if steps % update_every:
            raise ValueError(f"update_every is {update_every}; allowed: a divisor of rollout_steps {steps}")
