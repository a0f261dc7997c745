"""Who learns, and the interface between the training loop and a learner."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from math import nan
from typing import Annotated, Any, Final, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor, nn

from cprl.commons.spaces import Spaces
from cprl.learners.preferences import Preference, WantedRewards, check_preference
from cprl.policies.assignment import AgentIndices, agent_indices
from cprl.policies.decisions import Decider
from cprl.system.memory import check_memory
from cprl.values import Natural, Positive, Range, Value, checked

WEIGHTS, TARGET_WEIGHTS, EXPLORATION, SAMPLING, EVALUATION, EXHIBITION, NOISE = range(7)
"""The purposes of a lane's random numbers; each has its own seed."""

StartFrom: TypeAlias = Mapping[str, Mapping[str, Tensor]]
"""The state dict of the acting network with which each lane starts, by the lane's name."""

_LEAST_BYTES: Final = 4096
"""Of a lane, whatever it learns by: its name, seeds and random number generators."""


def lane_seeds(
    seed: int, *, replicas: Sequence[int], agents: Sequence[int], purpose: int
) -> list[tuple[int, int, int, int]]:
    """The seed of each lane, replica by replica: (seed of the run, replica, agent, purpose)."""
    return [(seed, replica, agent, purpose) for replica in replicas for agent in agents]


def lane_name(replica: int, agent: int) -> str:
    return f"replica_{replica}/agent_{agent}"


def lane_names(*, replicas: Sequence[int], agents: Sequence[int]) -> list[str]:
    """The name of each lane, replica by replica: "replica_0/agent_0" and so on."""
    return [lane_name(replica, agent) for replica in replicas for agent in agents]


@dataclass(frozen=True)
class LearningAgents(Value, stored=False):
    """Who learns: S agents of each of R replicas, what they want, and what they start from.

    Made and checked once, then handed whole to the learner.
    """

    spaces: Spaces
    """The shape and dtype of observations, and the number of actions A."""
    _: KW_ONLY
    agents: tuple[Natural, ...]
    """The indices of the agents, each once."""
    replicas: Annotated[int, Range(1, 2**20)]
    """The number of replicas R."""
    seed: int = 0
    """The seed of the run."""
    first_replica: int = 0
    """The index of the first replica, so that replica r can be trained alone."""
    reward_kind: Preference = "individual"
    """What they want, see `cprl.learners.preferences`."""
    start_from: StartFrom = field(default_factory=dict)
    """The weights with which acting networks, and their targets, start, by the lane's name; the others, such
    as critics, are new."""
    share_parameters: bool = False
    """Whether the agents of a replica share one network, which learns from all of them."""
    device: str | torch.device = "cpu"
    """The torch device of networks, stored turns and updates."""

    def __post_init__(self) -> None:
        super().__post_init__()
        agents, everyone = self.agents, self.spaces.agents
        check_preference("reward_kind", self.reward_kind, everyone)
        if not agents or len(set(agents)) < len(agents) or not set(agents) <= set(range(everyone)):
            raise ValueError(
                f"agents is {agents}; allowed: one or more of the agents 0 to {everyone - 1}, each once"
            )
        lanes = len(agents) * self.replicas
        check_memory(
            f"{self.replicas} replicas of {len(agents)} agents", lanes * _LEAST_BYTES, "fewer replicas"
        )

    @property
    def names(self) -> list[str]:
        """The name of each agent's networks, see `lane_names`."""
        return lane_names(replicas=self._numbers, agents=self.agents)

    def seeds(self, purpose: int) -> list[tuple[int, int, int, int]]:
        """The seed of each agent of each replica, see `lane_seeds`."""
        return lane_seeds(self.seed, replicas=self._numbers, agents=self.agents, purpose=purpose)

    @property
    def _numbers(self) -> range:
        return range(self.first_replica, self.first_replica + self.replicas)


class Learner(ABC):
    """Learns for S agents of each of R replicas; `ReplayLearner` is one."""

    actor: Any
    """Chooses the actions of these agents; callbacks get its `epsilon`."""

    def __init__(self, who: LearningAgents, settings: Any) -> None:
        self.who, self.settings = who, settings
        self.wants = WantedRewards(who.reward_kind)
        """What its agents want."""
        self.spaces, self.agents, self.replicas = who.spaces, who.agents, who.replicas
        self.steps = 0

    def __repr__(self) -> str:
        return f"{type(self).__name__}(agents={self.agents}, replicas={self.replicas})"

    def begin(self) -> None:  # noqa: B027 - most have nothing to do
        """Called before the first turn of a training: whatever is stored of an earlier one, the next turn
        begins new episodes."""

    @abstractmethod
    def store(self, batch: TensorDictBase) -> None:
        """Stores one step of every replica; the batch size is [R]."""

    @abstractmethod
    def update(self) -> Tensor | None:
        """Updates every agent once; returns the losses [R, S], or None if too little is stored."""

    def end_episode(self, ended: Tensor) -> None:  # noqa: B027 - likewise
        """Called after an episode has ended in the marked replicas, bool [R]."""

    @abstractmethod
    def values(self, batch: TensorDictBase) -> Tensor:
        """Each agent's estimate of the value of the state after the turn, [R, S]; for display only."""

    @abstractmethod
    def finite(self) -> Tensor:
        """Whether everything that the learner keeps of each agent is finite, above all weights and targets,
        bool [R, S]; called at the end of episodes and before the state is saved."""

    @abstractmethod
    def evaluation_actor(self, worlds: int) -> Any:
        """An actor with the current weights and the exploration of evaluation, for `worlds` worlds of each
        replica."""

    @abstractmethod
    def networks(self) -> dict[str, nn.Module]:
        """A copy of each agent's current acting network, by "replica_0/agent_0" and so on."""

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """The full state, the tensors themselves, not copies: training continues from it exactly."""

    @abstractmethod
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

    def __init__(self, replicas: int, agents: int, learners: Mapping[tuple[int, ...], Learner]) -> None:
        self._wants: list[tuple[Any, WantedRewards]] = []
        self._first = np.full(agents, nan)
        for indices, learner in learners.items():
            learner.wants.clear()
            self._wants.append((slice(None) if len(indices) == agents else list(indices), learner.wants))
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
