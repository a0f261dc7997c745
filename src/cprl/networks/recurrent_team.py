"""The recurrent networks of the members of a team as one network."""

from collections.abc import Sequence
from copy import deepcopy
from typing import Any

from torch import Tensor, nn

from cprl.networks.recurrent import RecurrentNetwork, StackedRecurrent
from cprl.networks.stacked import lane_state


class RecurrentTeam(nn.Module):
    """The recurrent networks of the S members of a team as one network, with the parameters of each member
    along a first axis, or with those of one network that all of them share.

    Args:
        networks: the members' networks, of one architecture, whose weights are copied; or the same one for
            each member, which is kept.
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
        own = state.movedim(-2, 0)
        begins = None if is_init is None else is_init.expand(len(seen), *is_init.shape)
        outputs, after = self.members(seen, own, begins)
        return outputs.movedim(0, -2), after.movedim(0, -2)

    def member_state(self, state: dict[str, Tensor], member: int) -> dict[str, Tensor]:
        """The state dict of a member's network, from the state dict of one team."""
        one: Any = deepcopy(self)
        one.load_state_dict(state)
        if self.shares:
            return {name: value.detach().clone() for name, value in one.members.state_dict().items()}
        return lane_state(one.members, member)
