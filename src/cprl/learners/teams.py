"""Teams: lanes that are not one agent each but all members of a team, one team a replica."""

from collections.abc import Callable, Sequence
from typing import Final

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from cprl.learners.engine.base import ListEngine
from cprl.learners.lanes import Acts, Lanes, init_network
from cprl.learners.transitions import LaneTurn, RewardKind, lane_turn, seen_next
from cprl.networks.agent import acting_part
from cprl.networks.team import TeamNetwork
from cprl.policies.lanes import LaneActor

MakeTeam = Callable[[Sequence[nn.Module]], nn.Module]
"""The networks of a team out of those of its members: `AgentNetworks`, a `TeamNetwork` first."""

_SHARED: Final = 1
"""Ends the seed of what a team has beside its members' networks."""


class Teams:
    """As `Lanes`, but that lane r is the team of all S seats in replica r.

    Each member draws its first weights and acts by the seeds that it would have as an agent by itself; what
    the team does as one is seeded as its first member.

    Args:
        members: the members of all teams.
        make_team: their networks as a team's; what it adds draws from torch's generator, which is seeded for
            each team.
    """

    def __init__(self, members: Lanes, make_team: MakeTeam) -> None:
        self.members, self._make_team = members, make_team
        self.stochastic = members.stochastic
        form = init_network(
            lambda: make_team([members.make_network() for _ in members.agents]), self.seeds(0)[0]
        )
        acting = acting_part(form)
        assert isinstance(acting, TeamNetwork)
        self._acting = acting

    def __len__(self) -> int:
        return self.members.replicas

    @property
    def observation_shape(self) -> tuple[int, ...]:
        """Of what a team sees: (S, C, X, Y)."""
        return *self.action_shape, *self.members.observation_shape

    @property
    def action_shape(self) -> tuple[int, ...]:
        """Of what a team does, and of what its members are paid in a rollout: (S,)."""
        return (len(self.members.agents),)

    @property
    def of_replica(self) -> int:
        """Lanes of a replica."""
        return 1

    def seeds(self, purpose: int) -> list[tuple[int, int, int, int]]:
        """A seed for each team."""
        return self.members.seeds(purpose)[:: len(self.members.agents)]

    def new_networks(self, purpose: int, device: str | torch.device) -> list[nn.Module]:
        """New networks for each team."""
        members, size = self.members.new_networks(purpose, device), len(self.members.agents)
        made = []
        for replica, seed in enumerate(self.seeds(purpose)):
            of_team = members[replica * size : (replica + 1) * size]
            made.append(init_network(lambda mine=of_team: self._make_team(mine), (*seed, _SHARED)).to(device))  # type: ignore[misc]
        return made

    def turn(self, batch: TensorDictBase, reward_kind: RewardKind) -> LaneTurn:
        """A turn of every team, as replay stores it: observations [R, S, C, X, Y], actions [R, S], and
        rewards [R], of the group.

        Args:
            batch: see `lane_turn`.
            reward_kind: "group".
        """
        turn = self.rollout_turn(batch, reward_kind)
        return turn._replace(reward=turn.reward[:, 0])

    def rollout_turn(self, batch: TensorDictBase, reward_kind: RewardKind) -> LaneTurn:
        """A turn of every team, as a rollout keeps it: as `turn`, with rewards [R, S] of each member."""
        agents = self.members.agents
        turn, size = lane_turn(agents, batch, reward_kind=reward_kind), (len(self), len(agents))
        of_members = {
            name: getattr(turn, name).reshape(*size, *getattr(turn, name).shape[1:])
            for name in ("observation", "action", "next_observation", "reward")
        }
        flags = {name: getattr(turn, name).reshape(size)[:, 0] for name in ("done", "terminated")}
        return turn._replace(**of_members, **flags)

    def seen_next(self, batch: TensorDictBase) -> Tensor:
        """What teams see at the end of a turn, uint8 [R, 1, S, C, X, Y]."""
        return seen_next(batch)[:, list(self.members.agents)].unsqueeze(1)

    def by_agent(self, losses: Tensor) -> Tensor:
        """What was told of each team, [R], of each of its members, [R, S]."""
        return losses[:, None].expand(-1, len(self.members.agents))

    def actor(self, engine: Acts, *, compile: bool) -> LaneActor:
        """See `Lanes.actor`."""
        return self.members.actor(
            _Members(engine, self), compile=compile and not isinstance(engine, ListEngine)
        )

    def evaluation_actor(self, engine: Acts, worlds: int, *, epsilon: float) -> LaneActor:
        """See `Lanes.evaluation_actor`."""
        return self.members.evaluation_actor(_Members(engine, self), worlds, epsilon=epsilon)

    def states(self, engine: Acts) -> dict[str, dict[str, Tensor]]:
        """The state dict of each member's acting network, by "replica_0/agent_0" and so on."""
        return self.members.states(_Members(engine, self))

    def networks(self, engine: Acts) -> dict[str, nn.Module]:
        """A copy of each member's acting network as it is now, by "replica_0/agent_0" and so on."""
        return self.members.networks(_Members(engine, self))

    def member_state(self, team: dict[str, Tensor], member: int) -> dict[str, Tensor]:
        """Of the state dict of a team's acting network, that of a member's own."""
        return self._acting.member_state(team, member)


class _Members:
    """The update of teams as one of their members, lane = replica x S + member.

    Args:
        engine: whose lanes are teams.
        teams: which.
    """

    def __init__(self, engine: Acts, teams: Teams) -> None:
        self._engine, self._teams = engine, teams
        self._size = len(teams), len(teams.members.agents)

    def outputs(self, observation: Tensor, *, part: int = 0) -> Tensor:
        """[R x S, k, C, X, Y] to [R x S, k, A]."""
        by_team = observation.view(*self._size, *observation.shape[1:]).transpose(1, 2)
        return self._engine.outputs(by_team, part=part).transpose(1, 2).flatten(0, 1)

    def network_state(self, lane: int) -> dict[str, Tensor]:
        """Of one member."""
        replica, member = divmod(lane, self._size[1])
        return self._teams.member_state(self._engine.network_state(replica), member)
