"""Lanes: the units that learn independently of each other, and how a turn is split into them.

A lane is one agent of one replica, or, if the agents of a replica are a team, that team. All lanes are
updated together, but none influences another.
"""

from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass, field
from math import prod
from typing import Annotated, Any, TypeAlias

import numpy as np
import torch
from torch import Tensor

from cprl import keys
from cprl.commons.spaces import Spaces
from cprl.keys import Turn, recurrent_state
from cprl.learners.transitions import LaneTurn, TransitionForm, joint_actions_by_agent
from cprl.objectives.rewards import Reward, check_reward
from cprl.policies.rng import Purpose, lane_names, lane_seeds
from cprl.values import Natural, Range, Value

StartFrom: TypeAlias = Mapping[str, Mapping[str, Tensor]]
"""State dicts of acting networks by the name of the agent that starts with them, see `Lanes.names`."""


@dataclass(frozen=True)
class Lanes(Value, stored=False):
    """The S agents of each of R replicas that learn by one algorithm, with their reward and initial weights.

    There are L = R x S lanes, lane = replica x S + position of the agent in `agents`; or, if the agents of
    a replica are a team, L = R. Each replica plays in W worlds. Members of a team have the same seeds of
    initial weights and exploration as independent agents.
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
    """The reward that the agents learn from, see `cprl.objectives.rewards`."""
    start_from: StartFrom = field(default_factory=dict)
    """The initial weights of acting networks and their targets, by the agent's name; agents that are not
    named, and all other networks, such as critics, start with new weights."""
    share_parameters: bool = False
    """True if the agents of a replica share one network, which learns from all of them."""
    are_teams: bool = False
    """True if the agents of a replica are one lane."""
    device: str | torch.device = "cpu"
    """The torch device of networks, stored turns and updates."""

    def __post_init__(self) -> None:
        super().__post_init__()
        everyone = self.spaces.agents
        check_reward("reward", self.reward, everyone)
        known = set(self.agents) & set(range(everyone))
        if not self.agents or len(known) < len(self.agents):
            raise ValueError(
                f"agents is {self.agents}; allowed: one or more of the agents 0 to {everyone - 1}, each once"
            )

    def __len__(self) -> int:
        return self.replicas * (1 if self.are_teams else len(self.agents))

    @property
    def members(self) -> tuple[int, ...]:
        """Return the shape of a lane's axis of members: (S,) for a team, () for one agent."""
        return (len(self.agents),) if self.are_teams else ()

    @property
    def sharing(self) -> int:
        """Return the number of consecutive lanes that share a network; 1 for teams, whose members share
        inside their lane."""
        return len(self.agents) if self.share_parameters and not self.are_teams else 1

    @property
    def names(self) -> list[str]:
        """Return the names of the agents of all replicas, e.g. "replica_0/agent_0", see `lane_names`."""
        return lane_names(replicas=self._replica_indices, agents=self.agents)

    def agent_seeds(self, purpose: Purpose) -> list[tuple[int, ...]]:
        """Return the seed of each agent of each replica for one purpose, see `lane_seeds`."""
        return lane_seeds(self.seed, replicas=self._replica_indices, agents=self.agents, purpose=purpose)

    def seeds(self, purpose: Purpose) -> list[tuple[int, ...]]:
        """Return the seed of each lane for one purpose; a team has the seed of its first member."""
        return self.agent_seeds(purpose)[:: prod(self.members)]

    @property
    def _replica_indices(self) -> range:
        return range(self.first_replica, self.first_replica + self.replicas)

    def form(self, **options: Any) -> TransitionForm:
        """Return the shapes of what lanes store of a turn.

        Args:
            options: fields of the `TransitionForm`. Unless they say otherwise, each member's own action and
                reward are stored.
        """
        return TransitionForm(
            observation_shape=(*self.members, *self.spaces.observation_shape),
            observation_dtype=self.spaces.observation_dtype,
            **{"action_shape": self.members, "reward_shape": self.members, **options},
        )

    def turn(self, turn: Turn, rewards: Any, form: TransitionForm) -> LaneTurn:
        """Return one transition of every lane in each of its worlds, C = L x W columns.

        Fields are views of the turn's entries where that is possible.

        Args:
            turn: one turn of all worlds.
            rewards: the shaped rewards of all agents, [B, N]; equal for all agents under the team reward.
            form: the shapes of what is stored.
        """
        reward = self._by_column(rewards)
        if self.are_teams and not form.reward_shape:  # all members get the same: one number is enough
            reward = reward[:, 0]
        if form.action_shape == self.members:
            action = self._by_column(turn.agents["action"])
        else:  # the actions of all agents of the game, see `OffPolicy`
            action = joint_actions_by_agent(self.agents, turn)
        cells = form.state_cells
        return LaneTurn(
            observation=self._by_column(turn.agents["observation"]),
            action=action,
            next_observation=self._by_column(turn.next_agents["observation"]),
            reward=reward,
            done=self._flags_by_column(turn.next_world[keys.DONE]),
            terminated=self._flags_by_column(turn.next_world[keys.TERMINATED]),
            recurrent_state=self.states(turn, recurrent_state.BEFORE, cells) if cells else None,
            next_recurrent_state=self.states(turn, recurrent_state.AFTER, cells) if cells else None,
            in_play=self._by_column(turn.agents["in_play"]) if form.has_in_play else None,
        )

    def _by_column(self, entry: Any) -> Any:
        """Return an entry of all agents of the game, [B, N, ...], by column, [C, ...], or [C, S, ...] of
        teams."""
        all_learn = self.agents == tuple(range(self.spaces.agents))
        selected = entry if all_learn else entry[:, list(self.agents)]
        return selected.reshape(-1, *self.members, *entry.shape[2:])

    def _flags_by_column(self, flags: Any) -> Any:
        """Return flags of worlds, bool [B, 1], by column, [C]."""
        count = len(self) // self.replicas
        return flags.repeat(count) if isinstance(flags, np.ndarray) else flags.repeat_interleave(count)

    def states(self, turn: Turn, name: str, cells: int) -> Any:
        """Return the states of recurrent networks in a turn, float32 [C, K], or [C, S, K] of teams, in the
        order of the fields of a `LaneTurn`.

        Args:
            name: `recurrent_state.BEFORE` or `recurrent_state.AFTER`.
            cells: the numbers K of a state.
        """
        states = recurrent_state.read_states(turn.agents, (slice(None), list(self.agents)), cells, name)
        return states.reshape(-1, *self.members, cells)

    def next_observations(self, turn: Turn) -> Tensor:
        """Return what lanes observe after a turn, [L, W, *observation_shape], or [L, W, S, ...] of teams."""
        return self.by_lane(self._by_column(turn.next_agents["observation"]))

    @property
    def columns(self) -> Tensor:
        """Return the columns of a `LaneTurn` that hold the worlds of each lane, int64 [L, W]."""
        return self.by_lane(torch.arange(len(self) * self.worlds))

    def by_lane(self, columns: Any) -> Tensor:
        """Reshape a field of a `LaneTurn`, [C, ...], to lanes and their worlds, [L, W, ...].

        Columns are ordered by the B = R x W worlds, and within a world by its lanes: its agents in the order
        of `agents`, or its one team.
        """
        values = torch.as_tensor(columns)
        if self.worlds == 1:
            return values[:, None]
        by_world = values.reshape(self.replicas, self.worlds, -1, *values.shape[1:])
        return by_world.swapaxes(1, 2).reshape(-1, self.worlds, *values.shape[1:])

    def by_world(self, values: Tensor) -> Tensor:
        """Reshape values of lanes in their worlds, [L, W, 1], or [L, W, S, 1] of teams, to values of the
        agents of each world, [B, S]."""
        by_replica = values.reshape(self.replicas, -1, self.worlds, prod(self.members))
        return by_replica.transpose(1, 2).reshape(-1, len(self.agents))

    def by_agent(self, values: Tensor) -> Tensor:
        """Expand one value of each network to values of the agents of each replica, [R, S]; members of a
        team, and agents that share a network, get the same value."""
        return values.view(self.replicas, -1).expand(-1, len(self.agents))

    def by_network(self, replica_flags: Tensor) -> Tensor:
        """Expand flags of replicas, bool [R], to flags of their networks, bool [L / `sharing`]."""
        return replica_flags.repeat_interleave(len(self) // self.sharing // self.replicas)


def outputs_by_agent(team_outputs: Callable[..., Any], members: int) -> Callable[..., Any]:
    """Return a function of single agents, as actors call it, from a function of teams.

    Args:
        team_outputs: maps observations [R, k, S, ...] of teams to outputs [R, k, S, A]; recurrent networks
            also read and return states [R, k, S, K].
        members: the number of members S.

    Returns:
        A function that maps [R x S, k, ...] to [R x S, k, A].
    """

    def agent_outputs(*inputs: Tensor) -> Any:
        inputs_by_team = (entry.reshape(-1, members, *entry.shape[1:]).transpose(1, 2) for entry in inputs)
        outputs = team_outputs(*inputs_by_team)
        if isinstance(outputs, tuple):
            return tuple(output.transpose(1, 2).flatten(0, 1) for output in outputs)
        return outputs.transpose(1, 2).flatten(0, 1)

    return agent_outputs
