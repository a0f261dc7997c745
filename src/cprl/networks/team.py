"""Networks of teams: those of the members as one, and networks of the observations of all members."""

from collections.abc import Sequence
from copy import deepcopy
from math import prod
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torchrl.modules import QMixer

from cprl.networks.mlp import MLPNetwork
from cprl.networks.recurrent import RecurrentNetwork, StackedRecurrent, state_shape_of
from cprl.networks.stacked import StackedMLP, lane_state, through_layers


class RecurrentTeam(nn.Module):
    """The recurrent networks of the S members of a team as one network, with the parameters of each member
    along a first axis, or with those of one network that all of them share.
    """

    def __init__(self, networks: Sequence[RecurrentNetwork]) -> None:
        super().__init__()
        first = networks[0]
        self.shares = len(networks) > 1 and all(network is first for network in networks)
        self.members: RecurrentNetwork | StackedRecurrent = (
            first if self.shares else StackedRecurrent(networks)
        )
        self.observation_dims, self.outputs = 1 + first.observation_dims, first.outputs
        self.state_shape = len(networks), *first.state_shape
        """The shape of the states of a team, (S, K)."""

    def forward(
        self, observation: Tensor, state: Tensor, is_init: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """As `RecurrentNetwork.forward`: observations [..., S, *shape], states [..., S, K] and `is_init`
        [..., T] to outputs [..., S, A] and states."""
        seen = observation.movedim(-self.observation_dims, 0)
        states = state.movedim(-2, 0)
        begins = None if is_init is None else is_init.expand(len(seen), *is_init.shape)
        outputs, after = self.members(seen, states, begins)
        return outputs.movedim(0, -2), after.movedim(0, -2)

    def member_state(self, state: dict[str, Tensor], member: int) -> dict[str, Tensor]:
        """The state dict of a member's network, from the state dict of one team."""
        one: Any = deepcopy(self)
        one.load_state_dict(state)
        if self.shares:
            return {name: value.detach().clone() for name, value in one.members.state_dict().items()}
        return lane_state(one.members, member)


class TeamNetwork(nn.Module):
    """The networks of the S members of a team as one network; members share no weights.

    Parameters are [S, in, out] and [S, 1, out]. After `stacked` they have an axis of R teams first:
    [R, S, in, out] and [R, S, 1, out].
    """

    def __init__(self, networks: Sequence[MLPNetwork]) -> None:
        super().__init__()
        self.members = StackedMLP(networks)

    def forward(self, observation: Tensor) -> Tensor:
        """uint8 [..., S, C, X, Y] to [..., S, A], with R teams [R, ..., S, C, X, Y] to [R, ..., S, A]."""
        of = self.members
        weights, biases = ([each.flatten(0, -3) for each in group] for group in (of.weights, of.biases))
        *teams, members = of.weights[0].shape[:-2]
        flat = observation.flatten(-of.observation_dims)
        by_team = flat.reshape(prod(teams), -1, members, flat.shape[-1])
        by_member = by_team.transpose(1, 2).flatten(0, 1).to(weights[0].dtype) / of.highest
        values = through_layers(by_member, weights, biases, relu_on_outputs=of.relu_on_outputs)
        of_teams = values.view(prod(teams), members, *values.shape[1:]).transpose(1, 2)
        return of_teams.reshape(*flat.shape[:-1], values.shape[-1])

    def member_state(self, state: dict[str, Tensor], member: int) -> dict[str, Tensor]:
        """The state dict of a member's network, from the state dict of one team."""
        one = deepcopy(self)
        one.load_state_dict(state)
        return one.members.lane_state(member)

    def stacked(self, teams: Sequence["TeamNetwork"]) -> "TeamNetwork":
        """One network with the parameters of R teams along a first axis; copies."""
        stack = deepcopy(self)
        for name in ("weights", "biases"):
            each = zip(*(getattr(team.members, name) for team in teams), strict=True)
            together = [torch.stack([one.detach() for one in of_layer]) for of_layer in each]
            setattr(stack.members, name, nn.ParameterList(together))
        return stack

    def lane_state(self, lane: int) -> dict[str, Tensor]:
        """Copies of the weights of one team of a stack, as its state dict."""
        return {name: value[lane].clone() for name, value in self.state_dict().items()}


class SharedTeam(nn.Module):
    """Like `TeamNetwork` for members that share one network, of any architecture."""

    stacks_over: ClassVar = ("network",)

    def __init__(self, network: nn.Module, *, observation_dims: int) -> None:
        super().__init__()
        self.network, self.observation_dims = network, 1 + observation_dims

    def forward(self, observation: Tensor) -> Tensor:
        """[..., S, *shape] to [..., S, A]."""
        given: Tensor = self.network(observation)
        return given

    def member_state(self, state: dict[str, Tensor], member: int) -> dict[str, Tensor]:
        return {name.removeprefix("network."): value for name, value in state.items()}


class ModuleTeam(nn.Module):
    """Like `TeamNetwork` for members' networks of any architecture; evaluates them one after the other."""

    def __init__(self, networks: Sequence[nn.Module], *, observation_dims: int) -> None:
        super().__init__()
        self.members, self._axis = nn.ModuleList(networks), -1 - observation_dims
        self.observation_dims = 1 + observation_dims

    def forward(self, observation: Tensor) -> Tensor:
        """[..., S, *shape] to [..., S, A]."""
        seen = observation.unbind(self._axis)
        return torch.stack(
            [member(observed) for member, observed in zip(self.members, seen, strict=True)], -2
        )

    def member_state(self, state: dict[str, Tensor], member: int) -> dict[str, Tensor]:
        prefix = f"members.{member}."
        return {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}


def team_network(
    networks: Sequence[nn.Module], *, observation_dims: int
) -> TeamNetwork | SharedTeam | ModuleTeam | RecurrentTeam:
    """The networks of the members of a team as one; a `SharedTeam` if they are all the same object, and a
    `RecurrentTeam` for recurrent ones."""
    if all(isinstance(network, RecurrentNetwork) for network in networks):
        return RecurrentTeam(networks)  # type: ignore[arg-type]
    if len(networks) > 1 and all(network is networks[0] for network in networks):
        return SharedTeam(networks[0], observation_dims=observation_dims)
    if all(isinstance(network, MLPNetwork) for network in networks):
        return TeamNetwork(networks)  # type: ignore[arg-type]
    return ModuleTeam(networks, observation_dims=observation_dims)


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
