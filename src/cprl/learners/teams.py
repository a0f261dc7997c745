"""Teams: lanes that hold all members of a team instead of one agent, one team per replica."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from cprl.commons.spaces import Spaces
from cprl.learners.engine.shared import is_list
from cprl.learners.lanes import Acts, Lanes, init_network
from cprl.learners.transitions import LaneTurn, lane_turn, seen_next
from cprl.networks.agent import acting_part
from cprl.networks.recurrent_team import RecurrentTeam
from cprl.networks.team import ModuleTeam, SharedTeam, TeamNetwork
from cprl.policies.lanes import LaneActor

MakeTeam = Callable[[Sequence[nn.Module]], nn.Module]
"""Makes the networks of a team from those of its members: `AgentNetworks`, that of `team_network` first.
Members that share parameters are one and the same network."""

_SHARED: Final = 1
"""The last number of the seed of the parts that a team adds to its members' networks."""


class Teams:
    """Like `Lanes`, but lane r is the team of the S agents of replica r.

    Each member has the seeds of initial weights and exploration that it would have as an independent agent.
    The team itself has the seeds of its first member.

    Args:
        members: the members of all teams.
        make_team: makes a team's networks from those of its members. Parts that it adds are initialised from
            torch's generator, which is seeded for each team.
        own_rewards: whether a replay buffer stores what each member wants; else one reward of the team.
    """

    def __init__(self, members: Lanes, make_team: MakeTeam, *, own_rewards: bool = False) -> None:
        self.members, self._make_team, self._own_rewards = members, make_team, own_rewards
        self.stochastic = members.stochastic
        form = init_network(
            lambda: make_team(self._shared([members.make_network() for _ in self._networks])),
            self.seeds(0)[0],
        )
        acting = acting_part(form)
        assert isinstance(acting, TeamNetwork | SharedTeam | ModuleTeam | RecurrentTeam)
        self._acting = acting

    def __len__(self) -> int:
        return self.members.replicas

    @property
    def sharing(self) -> int:
        """The number of lanes that share a network: a team has its own."""
        return 1

    @property
    def _networks(self) -> range:
        """The numbers of the networks of a team's members."""
        return range(len(self.members.agents) // self.members.sharing)

    def _shared(self, networks: Sequence[nn.Module]) -> list[nn.Module]:
        """The network of each member, from the different ones."""
        return [network for network in networks for _ in range(self.members.sharing)]

    @property
    def observation_shape(self) -> tuple[int, ...]:
        """The shape of a team's observation: (S, C, X, Y)."""
        return *self.member_shape, *self.members.observation_shape

    @property
    def action_shape(self) -> tuple[int, ...]:
        """The shape of a team's action, (S,)."""
        return *self.member_shape, *self.members.action_shape

    @property
    def member_shape(self) -> tuple[int, ...]:
        """The axis of a team's members, (S,), also the shape of its rewards in a rollout."""
        return (len(self.members.agents),)

    @property
    def reward_shape(self) -> tuple[int, ...]:
        """The shape of a team's reward in a replay buffer: (S,) if each member has its own, else ()."""
        return self.member_shape if self._own_rewards else ()

    @property
    def of_replica(self) -> int:
        """The number of lanes of a replica."""
        return 1

    def seeds(self, purpose: int) -> list[tuple[int, int, int, int]]:
        """A seed for each team."""
        return self.members.seeds(purpose)[:: len(self.members.agents)]

    def new_networks(self, purpose: int, device: str | torch.device) -> list[nn.Module]:
        """New networks for each team."""
        members, size = self.members.new_networks(purpose, device), len(self._networks)
        made = []
        for replica, seed in enumerate(self.seeds(purpose)):
            of_team = self._shared(members[replica * size : (replica + 1) * size])
            made.append(init_network(lambda mine=of_team: self._make_team(mine), (*seed, _SHARED)).to(device))  # type: ignore[misc]
        return made

    def turn(self, batch: TensorDictBase, rewards: Any) -> LaneTurn:
        """One transition of every team, as a replay buffer stores it: observations [R, S, C, X, Y], actions
        [R, S] and team rewards [R], or with `own_rewards` those of each member, [R, S].

        Args:
            batch: see `lane_turn`.
            rewards: of all agents, [R, N]; those of a team without `own_rewards` all the same.
        """
        turn = self.rollout_turn(batch, rewards)
        return turn if self._own_rewards else turn._replace(reward=turn.reward[:, 0])

    def rollout_turn(self, batch: TensorDictBase, rewards: Any) -> LaneTurn:
        """One transition of every team, as a rollout stores it: as `turn`, with rewards [R, S]."""
        agents = self.members.agents
        turn, size = lane_turn(agents, batch, rewards), (len(self), len(agents))
        of_members = {
            name: getattr(turn, name).reshape(*size, *getattr(turn, name).shape[1:])
            for name in ("observation", "action", "next_observation", "reward")
        }
        flags = {name: getattr(turn, name).reshape(size)[:, 0] for name in ("done", "terminated")}
        return turn._replace(**of_members, **flags)

    def seen_next(self, batch: TensorDictBase) -> Tensor:
        """The observations of teams after a turn, uint8 [R, 1, S, C, X, Y]."""
        return seen_next(batch)[:, list(self.members.agents)].unsqueeze(1)

    def recurrent_state(self, batch: TensorDictBase) -> Tensor:
        """The states that teams had before a turn, [R, S, H]."""
        return self.members.recurrent_state(batch).view(len(self), *self.member_shape, -1)

    def by_agent(self, losses: Tensor) -> Tensor:
        """Values of teams, [R], repeated for each of their members, [R, S]."""
        return losses[:, None].expand(-1, len(self.members.agents))

    def actor(self, engine: Acts, *, compile: bool) -> LaneActor:
        """See `Lanes.actor`."""
        return self.members.actor(_Members(engine, self), compile=compile and not is_list(engine))

    def evaluation_actor(self, engine: Acts, worlds: int, *, epsilon: float) -> LaneActor:
        """See `Lanes.evaluation_actor`."""
        return self.members.evaluation_actor(_Members(engine, self), worlds, epsilon=epsilon)

    def states(self, engine: Acts) -> dict[str, dict[str, Tensor]]:
        """The state dict of each member's acting network, by "replica_0/agent_0" and so on."""
        return self.members.states(_Members(engine, self))

    def networks(self, engine: Acts) -> dict[str, nn.Module]:
        """A copy of each member's current acting network, by "replica_0/agent_0" and so on."""
        return self.members.networks(_Members(engine, self))

    def member_state(self, team: dict[str, Tensor], member: int) -> dict[str, Tensor]:
        """The state dict of one member's network, from that of a team's acting network."""
        return self._acting.member_state(team, member)


def lanes_of(
    spaces: Spaces, *, make_team: MakeTeam | None, own_rewards: bool = False, **how: Any
) -> Lanes | Teams:
    """The lanes of independent agents, or with `make_team` of a team; see `Lanes` and `Teams` for the
    arguments."""
    members = Lanes(spaces, **how)
    if make_team and members.sees_peers:
        raise ValueError(
            "sees_peers is True; allowed for a team: False; its members' actions are stored together"
        )
    return Teams(members, make_team, own_rewards=own_rewards) if make_team else members


class _Members:
    """Presents an engine of teams as one of their members, with lane = replica x S + member.

    Args:
        engine: the engine whose lanes are teams.
        teams: the teams.
    """

    def __init__(self, engine: Acts, teams: Teams) -> None:
        self._engine, self._teams = engine, teams
        self._size = len(teams), len(teams.members.agents)

    def outputs(self, observation: Tensor, *recurrent: Tensor, part: int = 0) -> Any:
        """[R x S, k, C, X, Y] to [R x S, k, A]; of recurrent networks also states, likewise."""
        return self._by_team(partial(self._engine.outputs, part=part), observation, *recurrent)

    def first(self, lanes: int) -> Callable[..., Any]:
        """`outputs` of the members of the first teams."""
        return partial(self._by_team, self._engine.first(lanes // self._size[1]))

    def _by_team(self, outputs: Callable[..., Any], *inputs: Tensor) -> Any:
        """[r x S, k, ...] to [r x S, k, ...], through a function of [r, k, S, ...]."""
        members = self._size[1]
        given = outputs(*(own.view(-1, members, *own.shape[1:]).transpose(1, 2) for own in inputs))
        if isinstance(given, tuple):
            return tuple(own.transpose(1, 2).flatten(0, 1) for own in given)
        return given.transpose(1, 2).flatten(0, 1)

    def network_state(self, lane: int) -> dict[str, Tensor]:
        """The weights of one member."""
        replica, member = divmod(lane, self._size[1])
        return self._teams.member_state(self._engine.network_state(replica), member)
