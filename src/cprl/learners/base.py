"""Who learns, and the interface between the training loop and a learner."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field
from typing import Annotated, Any, TypeAlias

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from cprl import keys
from cprl.commons.spaces import Spaces
from cprl.keys import Turn
from cprl.objectives.preferences import Preference, WantedRewards, check_preference
from cprl.policies.rng import lane_names, lane_seeds
from cprl.values import Natural, Range, Value

StartFrom: TypeAlias = Mapping[str, Mapping[str, Tensor]]
"""The state dict of the acting network with which each lane starts, by the lane's name."""


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
    worlds: Annotated[int, Range(1, 2**20)] = 1
    """The worlds W in which each replica plays; world b of a batch belongs to replica b // W."""
    seed: int = 0
    """The seed of the run."""
    first_replica: int = 0
    """The index of the first replica, so that replica r can be trained alone."""
    reward_kind: Preference = "individual"
    """What they want, see `cprl.objectives.preferences`."""
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
        if hasattr(settings, "refuse_worlds"):
            settings.refuse_worlds(who.worlds)
        self.wants = WantedRewards(who.reward_kind)
        """What its agents want."""
        self.spaces, self.agents, self.replicas = who.spaces, who.agents, who.replicas
        self.worlds = who.worlds
        self.steps = 0
        """Steps of each replica that were stored: a turn of W worlds is W."""

    def __repr__(self) -> str:
        return f"{type(self).__name__}(agents={self.agents}, replicas={self.replicas})"

    def _wanted(self, turn: Turn) -> Any:
        """The rewards that all agents want in a turn, [B, N]; called once for each turn, in order."""
        rewards, done = turn.next_agents["reward"], turn.next_world[keys.DONE]
        return self.wants.add(rewards[..., 0], done[..., 0])

    def begin(self) -> None:  # noqa: B027 - most have nothing to do
        """Called before the first turn of a training: whatever is stored of an earlier one, the next turn
        begins new episodes."""

    @abstractmethod
    def store(self, batch: TensorDictBase | Turn) -> None:
        """Stores one turn of every world, of batch size [B], as collectors yield it."""

    @abstractmethod
    def update(self) -> Tensor | None:
        """Updates every agent as often as a turn asks for; returns the mean losses [R, S], or None if too
        little is stored."""

    def end_episode(self, ended: Tensor) -> None:  # noqa: B027 - likewise
        """Called after an episode has ended in the marked worlds, bool [B]."""

    @abstractmethod
    def values(self, batch: TensorDictBase | Turn) -> Tensor:
        """Each agent's estimate of the value of the state after the turn, [B, S]; for display only."""

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
