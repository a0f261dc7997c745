"""The networks of members in all replicas: those that learn, that act in training, and that have looked
ahead."""

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from typing import Any, Final

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.objectives import LossModule

from cprl.learners.engine.functional import total
from cprl.learners.lola.settings import LOLASettings
from cprl.learners.lola.steps import Steps, copy_all
from cprl.networks.finite import finite_lanes
from cprl.networks.stacked import lane_state, stack_lanes
from cprl.objectives import LOLADiCELoss

_CRITIC_EPS: Final = 1e-8


class MemberStacks:
    """One network of each of S members, with the parameters of R replicas; lane = replica x S + member.

    Args:
        networks: of each member, the parameters with an axis of replicas in front.
        forms: a network of one replica of each member, of which architecture alone matters.
    """

    def __init__(self, networks: Sequence[nn.Module], forms: Sequence[nn.Module]) -> None:
        self.networks, self._forms = list(networks), list(forms)

    def of_members(self, observation: Tensor) -> Tensor:
        """[R, .., S, *shape] to [R, .., S, outputs]."""
        form: Any = self._forms[0]
        seen = observation.unbind(-1 - form.observation_dims)
        return torch.stack([own(of) for own, of in zip(self.networks, seen, strict=True)], -2)

    def outputs(self, observation: Tensor, *, part: int = 0) -> Tensor:
        """See `Acts`: [R x S, k, *shape] to [R x S, k, outputs]; there is one part, 0."""
        by_replica = observation.reshape(-1, len(self.networks), *observation.shape[1:]).transpose(1, 2)
        return self.of_members(by_replica).transpose(1, 2).flatten(0, 1)

    def first(self, lanes: int) -> Callable[[Tensor], Tensor]:
        """See `Acts`."""
        replicas = lanes // len(self.networks)
        fewer = []
        for form, network in zip(self._forms, self.networks, strict=True):
            one = stack_lanes([form] * replicas)
            for own, of_all in zip(one.parameters(), network.parameters(), strict=True):
                own.requires_grad_(False).data = of_all.data[:replicas]  # the same memory
            fewer.append(one)
        return MemberStacks(fewer, self._forms).outputs

    def network_state(self, lane: int) -> dict[str, Tensor]:
        """See `Acts`."""
        replica, member = divmod(lane, len(self.networks))
        return lane_state(self.networks[member], replica)

    def parameters(self) -> list[list[nn.Parameter]]:
        """The parameters of each member, [R, ...] each."""
        return [list(network.parameters()) for network in self.networks]

    def copy_from(self, other: "MemberStacks", members: Sequence[int]) -> None:
        """Takes the weights of some members, in place."""
        for member in members:
            pairs = zip(self.parameters()[member], other.parameters()[member], strict=True)
            for own, value in pairs:
                own.data.copy_(value.data)


class LOLANetworks:
    """The actors and critics of all teams, and their optimisers.

    Args:
        networks: `AgentNetworks` of "actor" and "critic" for each lane, replica by replica.
        members: the number of members S.
        make_loss: makes the loss from an `nn.ModuleList` of the members' networks.
        settings: the hyperparameters.
    """

    def __init__(
        self,
        networks: Sequence[Any],
        *,
        members: int,
        make_loss: Callable[[nn.Module], LossModule],
        settings: LOLASettings,
    ) -> None:
        stacks: list[Any] = [stack_lanes(networks[member::members]) for member in range(members)]
        forms = networks[:members]
        actors, critics = (
            ([own[name] for own in stacks], [own[name] for own in forms]) for name in ("actor", "critic")
        )
        self.acting, self.critics = MemberStacks(*actors), MemberStacks(*critics)
        self.playing = MemberStacks(deepcopy(actors[0]), actors[1])
        self.loss = make_loss(nn.ModuleList(stacks))
        looks = isinstance(self.loss, LOLADiCELoss)
        self.ahead = MemberStacks(deepcopy(actors[0]), actors[1]) if looks else None
        self.policy_steps = Steps(
            self.acting.parameters(),
            name=settings.optimizer,
            learning_rate=settings.learning_rate,
            eps=settings.adam_eps,
            max_grad_norm=settings.max_grad_norm,
        )
        self.critic_steps = Steps(
            self.critics.parameters(),
            name="adam",
            learning_rate=settings.critic_learning_rate,
            eps=_CRITIC_EPS,
        )

    def play(self, member: int | None) -> None:
        """From now on all act by their present weights; with a member, the others by those ahead."""
        everyone = range(len(self.acting.networks))
        self.playing.copy_from(self.acting, [own for own in everyone if member in (None, own)])
        if member is not None and self.ahead is not None:
            self.playing.copy_from(self.ahead, [own for own in everyone if own != member])

    def look_ahead(self, rollouts: TensorDict) -> None:
        """Puts the weights ahead to those after a naive step, from rollouts [R, B, T] of the present ones."""
        assert isinstance(self.loss, LOLADiCELoss)
        assert self.ahead is not None
        for member, table in enumerate(self.loss.look_ahead(rollouts)):
            of_loss = self.loss.actors_params.get(str(member)).items(True, True)
            names = {value.data_ptr(): key for key, value in of_loss}
            pairs = zip(self.acting.parameters()[member], self.ahead.parameters()[member], strict=True)
            for own, then in pairs:
                then.data.copy_(table.get(names[own.data_ptr()]))

    def update_policies(self, rollouts: TensorDict) -> None:
        """One step of all policies."""
        self.policy_steps.descend(total(self.loss(rollouts), self.loss))

    def update_critics(self, observation: Tensor, target: Tensor) -> None:
        """One step of all critics along their mean squared errors.

        Args:
            observation: [R, P, T, S, *shape].
            target: the values wanted, [R, P, T, S, 1].
        """
        error = (self.critics.of_members(observation) - target).square()
        self.critic_steps.descend(error.mean((1, 2)).sum())

    def finite(self) -> Tensor:
        """Whether all weights and what the optimisers keep are finite, of each member, bool [R, S]."""
        stacks = [own for own in (self.acting, self.critics, self.playing, self.ahead) if own is not None]
        each = []
        for member in range(len(self.acting.networks)):
            weights: list[Tensor] = [value for own in stacks for value in own.parameters()[member]]
            kept = [value for own in (self.policy_steps, self.critic_steps) for value in own.kept(member)]
            each.append(finite_lanes([*weights, *kept]))
        return torch.stack(each, -1)

    def state_dict(self) -> dict[str, Any]:
        """The full state; the tensors themselves, not copies."""
        return {
            **{name: _data(own) for name, own in self._stacks().items()},
            "policy_steps": self.policy_steps.state_dict(),
            "critic_steps": self.critic_steps.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from a state that `state_dict` returned."""
        for name, own in self._stacks().items():
            copy_all(_data(own), state[name])
        self.policy_steps.load_state_dict(state["policy_steps"])
        self.critic_steps.load_state_dict(state["critic_steps"])

    def _stacks(self) -> dict[str, MemberStacks]:
        found = {"actors": self.acting, "critics": self.critics, "playing": self.playing}
        return found if self.ahead is None else {**found, "ahead": self.ahead}


def _data(stacks: MemberStacks) -> list[list[Tensor]]:
    return [[value.data for value in of] for of in stacks.parameters()]
