"""Lanes: who learns apart. A lane is one agent of one replica, or the team of a replica."""

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field
from math import prod
from typing import Annotated, Any, TypeAlias

import torch
from torch import Tensor

from cprl import recurrent_state
from cprl.commons.spaces import Spaces
from cprl.keys import Turn
from cprl.learners.transitions import LaneTurn, TransitionForm, by_lane, joint_actions, lane_turn
from cprl.objectives.rewards import Reward, check_reward
from cprl.policies.rng import Purpose, lane_names, lane_seeds
from cprl.values import Natural, Range, Value

StartFrom: TypeAlias = Mapping[str, Mapping[str, Tensor]]
"""The state dict of the acting network with which each agent starts, by the agent's name."""


@dataclass(frozen=True)
class Lanes(Value, stored=False):
    """Who learns: S agents of each of R replicas, in W worlds; what they want, and what they start from.

    There are L = R x S lanes, or, where a lane is a team of S agents, L = R, in order of replicas. Members of
    a team have the seeds of initial weights and exploration that they would have as independent agents.
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
    reward: Reward = "individual"
    """What they want, see `cprl.objectives.rewards`."""
    start_from: StartFrom = field(default_factory=dict)
    """The weights with which acting networks, and their targets, start, by the agent's name; the others, such
    as critics, are new."""
    share_parameters: bool = False
    """Whether the agents of a replica share one network, which learns from all of them."""
    are_teams: bool = False
    """Whether the agents of a replica are one lane."""
    device: str | torch.device = "cpu"
    """The torch device of networks, stored turns and updates."""

    def __post_init__(self) -> None:
        super().__post_init__()
        agents, everyone = self.agents, self.spaces.agents
        check_reward("reward", self.reward, everyone)
        if not agents or len(set(agents)) < len(agents) or not set(agents) <= set(range(everyone)):
            raise ValueError(
                f"agents is {agents}; allowed: one or more of the agents 0 to {everyone - 1}, each once"
            )

    def __len__(self) -> int:
        return self.replicas * (1 if self.are_teams else len(self.agents))

    @property
    def members(self) -> tuple[int, ...]:
        """The axes of the members of a lane: (S,) of a team, () of one agent."""
        return (len(self.agents),) if self.are_teams else ()

    @property
    def sharing(self) -> int:
        """How many consecutive lanes share a network; members of teams share within theirs."""
        return len(self.agents) if self.share_parameters and not self.are_teams else 1

    @property
    def names(self) -> list[str]:
        """The name of each agent's networks, see `lane_names`."""
        return lane_names(replicas=self._numbers, agents=self.agents)

    def agent_seeds(self, purpose: Purpose) -> list[tuple[int, ...]]:
        """The seed of each agent of each replica, see `lane_seeds`."""
        return lane_seeds(self.seed, replicas=self._numbers, agents=self.agents, purpose=purpose)

    def seeds(self, purpose: Purpose) -> list[tuple[int, ...]]:
        """The seed of each lane; that of a team is its first member's."""
        return self.agent_seeds(purpose)[:: prod(self.members)]

    @property
    def _numbers(self) -> range:
        return range(self.first_replica, self.first_replica + self.replicas)

    def form(self, **more: Any) -> TransitionForm:
        """What lanes store of a turn: of each member its action and its reward, unless `more` says other."""
        return TransitionForm(
            observation_shape=(*self.members, *self.spaces.observation_shape),
            observation_dtype=self.spaces.observation_dtype,
            **{"action_shape": self.members, "reward_shape": self.members, **more},
        )

    def turn(self, turn: Turn, rewards: Any, form: TransitionForm) -> LaneTurn:
        """One transition of every lane in each of its worlds, C = L x W columns; see `lane_turn`.

        Args:
            rewards: of all agents, [B, N]; those of a team that shares its reward all the same.
            form: what of it is stored.
        """
        lanes = lane_turn(self.agents, turn, rewards, are_team=self.are_teams)
        if self.are_teams and not form.reward_shape:
            lanes = lanes._replace(reward=lanes.reward[:, 0])
        if form.action_shape != self.members:
            lanes = lanes._replace(action=joint_actions(self.agents, turn))
        if form.state_cells:
            before = self.states(turn, recurrent_state.BEFORE, form.state_cells)
            after = self.states(turn, recurrent_state.AFTER, form.state_cells)
            lanes = lanes._replace(recurrent_state=before, next_recurrent_state=after)
        if form.has_in_play:
            in_play = turn.agents["in_play"][:, list(self.agents)]
            lanes = lanes._replace(in_play=in_play.reshape(-1, *self.members))
        return lanes

    def states(self, turn: Turn, name: str, cells: int) -> Any:
        """The states of recurrent networks in a turn, float32 [C, K], of teams [C, S, K]; an array as those
        of a `LaneTurn`.

        Args:
            name: `recurrent_state.BEFORE` or `AFTER`.
            cells: the numbers K of a state.
        """
        states = recurrent_state.read(turn.agents, (slice(None), list(self.agents)), cells, name)
        return states.reshape(-1, *self.members, cells)

    def seen_next(self, turn: Turn) -> Tensor:
        """The observations of lanes after a turn, [L, W, *observation_shape]."""
        seen = torch.as_tensor(turn.next_agents["observation"])[:, list(self.agents)]
        return self.by_lane(seen.reshape(-1, *self.members, *self.spaces.observation_shape))

    @property
    def columns(self) -> Tensor:
        """Where the worlds of each lane stand in a `LaneTurn`, int64 [L, W]."""
        return self.by_lane(torch.arange(len(self) * self.worlds))

    def by_lane(self, columns: Any) -> Tensor:
        """A field of a `LaneTurn`, [C, ...], as one of lanes and their worlds, [L, W, ...]."""
        return by_lane(torch.as_tensor(columns), replicas=self.replicas, worlds=self.worlds)

    def by_world(self, values: Tensor) -> Tensor:
        """Values of lanes in their worlds, [L, W, 1], of teams [L, W, S, 1], as those of the agents of each
        world, [B, S]."""
        by_replica = values.reshape(self.replicas, -1, self.worlds, prod(self.members))
        return by_replica.transpose(1, 2).reshape(-1, len(self.agents))

    def by_agent(self, values: Tensor) -> Tensor:
        """Values of networks as values of the agents of each replica, [R, S]; members of a team, and agents
        that share a network, have the same."""
        return values.view(self.replicas, -1).expand(-1, len(self.agents))

    def by_network(self, marked: Tensor) -> Tensor:
        """Flags of replicas, [R], as flags of networks."""
        return marked.repeat_interleave(len(self) // self.sharing // self.replicas)
