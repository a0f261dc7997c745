"""Networks of teams: those of the members as one, and networks of the observations of all members."""

from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torchrl.modules import QMixer

from cprl.networks.mlp import MLPNetwork
from cprl.networks.recurrent import RecurrentNetwork, state_shape_of
from cprl.networks.stacked import StackedMLP, lane_state, stack_lanes


class Team(nn.Module):
    """The networks of the S members of a team as one.

    Args:
        networks: of each member; those who share parameters have one and the same.
        observation_dims: the number of axes of one member's observation.
    """

    def __init__(self, networks: Sequence[nn.Module], *, observation_dims: int) -> None:
        super().__init__()
        first = networks[0]
        self.shares = len(networks) > 1 and all(network is first for network in networks)
        self.observation_dims, self.outputs = 1 + observation_dims, getattr(first, "outputs", None)
        of_member = state_shape_of(first)
        self.state_shape = None if of_member is None else (len(networks), *of_member)
        """The shape of the states of a team, (S, K); None for networks without."""
        stacks = all(isinstance(network, MLPNetwork | RecurrentNetwork) for network in networks)
        self.members: Any = first
        """A network that all share; a stack of S lanes; or, of other architectures, a list."""
        if not self.shares:
            self.members = stack_lanes(networks) if stacks else nn.ModuleList(networks)

    @property
    def stacks_over(self) -> tuple[str, ...]:
        """See `cprl.networks.stacked.stack_lanes`; teams of other networks are vmapped."""
        shares = self.shares and self.state_shape is None
        return ("members",) if shares or isinstance(self.members, StackedMLP) else ()

    def forward(self, observation: Tensor, *recurrent: Tensor) -> Any:
        """Observations [..., S, *shape] to [..., S, A]; recurrent networks also read states [..., S, K] and
        `is_init` [..., T], and return states, see `cprl.networks.recurrent`."""
        if self.shares and not recurrent:
            return self.members(observation)
        if isinstance(self.members, nn.ModuleList):
            by_member = observation.unbind(-self.observation_dims)
            outputs = [member(seen) for member, seen in zip(self.members, by_member, strict=True)]
            return torch.stack(outputs, -2)
        axis = self.members.lane_axis if isinstance(self.members, StackedMLP) else 0
        seen = observation.movedim(-self.observation_dims, axis)
        if not recurrent:
            return self.members(seen).movedim(axis, -2)
        state, *is_init = recurrent
        begins = (flags.expand(len(seen), *flags.shape) for flags in is_init)
        given, after = self.members(seen, state.movedim(-2, 0), *begins)
        return given.movedim(0, -2), after.movedim(0, -2)

    def member_state(self, state: Mapping[str, Tensor], member: int) -> dict[str, Tensor]:
        """The state dict of a member's network, from the state dict of one team."""
        team = deepcopy(self)
        team.load_state_dict(state)
        if isinstance(team.members, nn.ModuleList) or self.shares:
            network = team.members if self.shares else team.members[member]
            return {name: value.detach().clone() for name, value in network.state_dict().items()}
        return lane_state(team.members, member)


class CentralCritic(nn.Module):
    """The value of a state for a team, from the observations of all members; the same for each member."""

    stacks_over: ClassVar = ("network",)

    def __init__(self, network: nn.Module, members: int) -> None:
        super().__init__()
        self.network, self.members = network, members
        self.state_shape = state_shape_of(network)

    def forward(self, observation: Tensor, *recurrent: Tensor) -> Any:
        """uint8 [..., S, C, X, Y] to the same value for each member, [..., S, 1]; of a recurrent network with
        its state and `is_init`, and to its states, see `cprl.networks.recurrent`."""
        if not recurrent:
            return self._for_each(self.network(observation))
        value, after = self.network(observation, *recurrent)
        return self._for_each(value), after

    def _for_each(self, value: Tensor) -> Tensor:
        return value.unsqueeze(-2).expand(*value.shape[:-1], self.members, 1)


class JointCritics(nn.Module):
    """The value of joint actions to each of S members, by a critic for each; critics share no weights.

    Args:
        heads: each member's network of a vector, to one value: the features of what all members observe, then
            the actions of all members, one-hot.
        encoders: each member's network of what all members observe, (S, *shape), to features, which pass
            through ReLU; None for the observations themselves.
        observation_dims: the number of axes of one member's observation.
        highest: the largest value of an observation; without encoders, observations are divided by it.
    """

    stacks_over: ClassVar = ("heads", "encoders")

    def __init__(
        self,
        heads: nn.Module,
        encoders: nn.Module | None,
        *,
        observation_dims: int,
        highest: float,
    ) -> None:
        super().__init__()
        self.heads, self.encoders = heads, encoders
        self._dims, self.highest = 1 + observation_dims, highest

    def forward(self, observation: Tensor, joint_action: Tensor) -> Tensor:
        """Observations [..., S, *shape] and float one-hot actions [..., S, S, A], in row i those by which
        member i's critic judges, to values [..., S, 1]."""
        members = joint_action.shape[-2]
        if self.encoders is None:
            flat = observation.flatten(-self._dims).to(joint_action.dtype) / self.highest
            features = flat.unsqueeze(-2).expand(*flat.shape[:-1], members, flat.shape[-1])
        else:
            everyone = observation.unsqueeze(-1 - self._dims)
            leading, shape = observation.shape[: -self._dims], observation.shape[-self._dims :]
            features = self.encoders(everyone.expand(*leading, members, *shape)).relu()
        values: Tensor = self.heads(torch.cat([features, joint_action.flatten(-2)], -1))
        return values


class Mixing(nn.Module):
    """TorchRL's `QMixer` with the observations of all members as the state.

    Its weights on the members' values are never negative, so the best action of each member is the best for
    the team. Source: Rashid et al., "QMIX: Monotonic Value Function Factorisation for Deep Multi-Agent
    Reinforcement Learning" (2018).
    """

    def __init__(self, observation_shape: Sequence[int], *, members: int, cells: int, highest: float) -> None:
        super().__init__()
        self.mixer = QMixer((members, *observation_shape), cells, members, device="cpu")
        self.highest = highest

    def forward(self, chosen: Tensor, observation: Tensor) -> Tensor:
        """The members' values [..., S, 1] and uint8 [..., S, C, X, Y] to the team's value, [..., 1]."""
        state = observation.to(chosen.dtype) / self.highest
        value: Tensor = self.mixer(chosen.contiguous(), state)
        return value
