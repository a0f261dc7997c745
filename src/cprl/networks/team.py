"""Networks of teams: the members' networks as one, critics of what all members observe, and mixing
networks."""

from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torchrl.modules import QMixer

from cprl.networks.mlp import MLPNetwork
from cprl.networks.recurrent import RecurrentNetwork, state_shape_of
from cprl.networks.stacked import StackedMLP, lane_state, stack_lanes


class TeamNetwork(nn.Module):
    """The networks of the S members of a team as one network.

    Args:
        networks: the network of each member; for members that share parameters, the same one S times.
        observation_dims: the number of axes of one member's observation.
    """

    def __init__(self, networks: Sequence[nn.Module], *, observation_dims: int) -> None:
        super().__init__()
        first = networks[0]
        self.shares = len(networks) > 1 and all(network is first for network in networks)
        self.observation_dims = 1 + observation_dims
        self.outputs = getattr(first, "outputs", None)
        shape = state_shape_of(first)
        self.state_shape = None if shape is None else (len(networks), *shape)
        """The shape of the states of a team, (S, K); None for networks without a state."""
        are_stackable = all(isinstance(network, MLPNetwork | RecurrentNetwork) for network in networks)
        self.members: Any = first
        """The network that all members share; or a stack of S lanes; or a list of networks whose
        architectures have no stack."""
        if not self.shares:
            self.members = stack_lanes(networks) if are_stackable else nn.ModuleList(networks)

    @property
    def inner_network_names(self) -> tuple[str, ...]:
        """Return the names of the inner networks that `cprl.networks.stacked.stack_lanes` stacks by
        themselves; a team without any is computed by `torch.vmap`."""
        is_shared_network = self.shares and self.state_shape is None
        return ("members",) if is_shared_network or isinstance(self.members, StackedMLP) else ()

    def forward(self, observation: Tensor, *recurrent: Tensor) -> Any:
        """Map the observations of all members, [..., S, *shape], to their outputs, [..., S, A].

        Recurrent networks also read states [..., S, K] and `is_init` [..., T], and return states, see
        `cprl.networks.recurrent`.
        """
        if self.shares and not recurrent:
            return self.members(observation)
        if isinstance(self.members, nn.ModuleList):
            by_member = observation.unbind(-self.observation_dims)
            outputs = [network(entry) for network, entry in zip(self.members, by_member, strict=True)]
            return torch.stack(outputs, -2)
        # A stack has its lanes, here the members, on another axis than a team's observations have members.
        lane_axis = self.members.lane_axis if isinstance(self.members, StackedMLP) else 0
        by_lane = observation.movedim(-self.observation_dims, lane_axis)
        if not recurrent:
            return self.members(by_lane).movedim(lane_axis, -2)
        state, *is_init = recurrent
        is_init_by_lane = (flags.expand(len(by_lane), *flags.shape) for flags in is_init)
        output, state_after = self.members(by_lane, state.movedim(-2, 0), *is_init_by_lane)
        return output.movedim(0, -2), state_after.movedim(0, -2)

    def member_state(self, state: Mapping[str, Tensor], member: int) -> dict[str, Tensor]:
        """Return the state dict of a member's network, from the state dict of one team.

        Args:
            state: the state dict of a team like this one.
            member: the index of the member in the team.
        """
        team = deepcopy(self)
        team.load_state_dict(state)
        if isinstance(team.members, nn.ModuleList) or self.shares:
            network = team.members if self.shares else team.members[member]
            return {name: value.detach().clone() for name, value in network.state_dict().items()}
        return lane_state(team.members, member)


class CentralCritic(nn.Module):
    """A critic that judges a state by the observations of all members; each member gets the same value.

    Args:
        network: maps the observations of all members, [..., S, C, X, Y], to one value, [..., 1].
        members: the number of members S.
    """

    inner_network_names: ClassVar = ("network",)

    def __init__(self, network: nn.Module, members: int) -> None:
        super().__init__()
        self.network = network
        self.members = members
        self.state_shape = state_shape_of(network)

    def forward(self, observation: Tensor, *recurrent: Tensor) -> Any:
        """Map observations, uint8 [..., S, C, X, Y], to the value, the same for each member, [..., S, 1].

        A recurrent network also reads a state and `is_init`, and returns states, see
        `cprl.networks.recurrent`.
        """
        if not recurrent:
            return self._expand_to_members(self.network(observation))
        value, state_after = self.network(observation, *recurrent)
        return self._expand_to_members(value), state_after

    def _expand_to_members(self, value: Tensor) -> Tensor:
        return value.unsqueeze(-2).expand(*value.shape[:-1], self.members, 1)


class JointCritics(nn.Module):
    """A critic for each of S members, which judges the joint actions of all members.

    Critics share no weights. Each first encodes what all members observe, then maps the features and the
    joint action to one value.

    Args:
        heads: the second network of each critic: from a vector, the features and then the actions of all
            members, one-hot, to one value.
        encoders: the first network of each critic: from what all members observe, (S, *shape), to features,
            which pass through ReLU; None to take the observations themselves as features.
        observation_dims: the number of axes of one member's observation.
        highest: the largest value of an observation; without encoders, observations are divided by it.
    """

    inner_network_names: ClassVar = ("heads", "encoders")

    def __init__(
        self,
        heads: nn.Module,
        encoders: nn.Module | None,
        *,
        observation_dims: int,
        highest: float,
    ) -> None:
        super().__init__()
        self.heads = heads
        self.encoders = encoders
        self._dims = 1 + observation_dims  # the axes of what all members observe
        self.highest = highest

    def forward(self, observation: Tensor, joint_action: Tensor) -> Tensor:
        """Map observations [..., S, *shape] and joint actions to the members' values, [..., S, 1].

        Args:
            joint_action: float one-hot [..., S, S, A]; row i is the joint action that member i's critic
                judges.
        """
        members = joint_action.shape[-2]
        if self.encoders is None:
            flat = observation.flatten(-self._dims).to(joint_action.dtype) / self.highest
            features = flat.unsqueeze(-2).expand(*flat.shape[:-1], members, flat.shape[-1])
        else:
            batch_shape = observation.shape[: -self._dims]
            shape = observation.shape[len(batch_shape) :]
            for_each_critic = observation.unsqueeze(-1 - self._dims).expand(*batch_shape, members, *shape)
            features = self.encoders(for_each_critic).relu()
        return self.heads(torch.cat([features, joint_action.flatten(-2)], -1))


class Mixing(nn.Module):
    """The mixing network of QMIX, TorchRL's `QMixer`: it maps the members' values to the team's value.

    The state by which it mixes is the observations of all members. Its weights on the members' values are
    never negative, so the best action of each member is the best for the team.

    Source: Rashid et al., "QMIX: Monotonic Value Function Factorisation for Deep Multi-Agent Reinforcement
    Learning" (2018).
    """

    def __init__(self, observation_shape: Sequence[int], *, members: int, cells: int, highest: float) -> None:
        super().__init__()
        self.mixer = QMixer((members, *observation_shape), cells, members, device="cpu")
        self.highest = highest

    def forward(self, chosen: Tensor, observation: Tensor) -> Tensor:
        """Map the values of the members' chosen actions, [..., S, 1], and their observations, uint8
        [..., S, C, X, Y], to the team's value, [..., 1]."""
        state = observation.to(chosen.dtype) / self.highest
        return self.mixer(chosen.contiguous(), state)
