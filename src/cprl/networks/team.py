"""Networks of teams: the members' own side by side, and what sees all that the members see."""

from collections.abc import Sequence
from copy import deepcopy
from math import prod

import torch
from torch import Tensor, nn
from torchrl.modules import QMixer

from cprl.networks.mlp import MLPNetwork
from cprl.networks.stacked import StackedMLP, through_layers


class TeamNetwork(nn.Module):
    """The networks of the S members of a team, which share no weights, as one.

    Parameters are [S, in, out] and [S, 1, out]; with the axis of R teams in front, as `stacked` gives them,
    [R, S, in, out] and [R, S, 1, out].

    Args:
        networks: of the members, of one shape; their weights are copied.

    Raises:
        ValueError: where the networks differ in shape.
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
        """Of a state dict of one such team: the part of a member, as the state dict of its own network."""
        one = deepcopy(self)
        one.load_state_dict(state)
        return one.members.lane_state(member)

    def stacked(self, teams: Sequence["TeamNetwork"]) -> "TeamNetwork":
        """The networks of R teams as one whose parameters carry an axis of them in front; copies."""
        stack = deepcopy(self)
        for name in ("weights", "biases"):
            each = zip(*(getattr(team.members, name) for team in teams), strict=True)
            together = [torch.stack([one.detach() for one in of_layer]) for of_layer in each]
            setattr(stack.members, name, nn.ParameterList(together))
        return stack

    def lane_state(self, lane: int) -> dict[str, Tensor]:
        """Of a stack: copies of the weights of one team, as its state dict."""
        return {name: value[lane].clone() for name, value in self.state_dict().items()}


class CentralCritic(nn.Module):
    """What a team expects, from all that its members see, told to each of them.

    Args:
        network: one value out of the observations of all members, (S, C, X, Y).
        members: S.
    """

    def __init__(self, network: nn.Module, members: int) -> None:
        super().__init__()
        self.network, self.members = network, members

    def forward(self, observation: Tensor) -> Tensor:
        """uint8 [..., S, C, X, Y] to the same value for each member, [..., S, 1]."""
        value: Tensor = self.network(observation)
        return value.unsqueeze(-2).expand(*value.shape[:-1], self.members, 1)

    def stacked(self, critics: Sequence["CentralCritic"]) -> "CentralCritic":
        """The critics of many teams as one; copies."""
        return CentralCritic(StackedMLP([critic.network for critic in critics]), self.members)  # type: ignore[misc]


class Mixing(nn.Module):
    """TorchRL's `QMixer` over what all members see, side by side, as the state.

    Its weights on the members' values are never negative, so that what is best for each is best for the team.
    Source: Rashid et al., "QMIX: Monotonic Value Function Factorisation for Deep Multi-Agent Reinforcement
    Learning" (2018).

    Args:
        observation_shape: (C, X, Y) of a member's observation.
        members: S.
        cells: units of the mixing layer.
        highest: the largest value of an observation; layers see 0..1.
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
