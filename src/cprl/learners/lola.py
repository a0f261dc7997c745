"""LOLA: the memory and the networks of teams whose members learn with the others' learning in view."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from typing import Any, Final

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.objectives import LossModule

from cprl.keys import Turn
from cprl.learners.draw import Draw
from cprl.learners.lanes import Lanes
from cprl.learners.optimizers import UpdateRule, clip_by_norm, torch_optimizer
from cprl.learners.refusals import refuse_other_parts
from cprl.learners.rollouts import Rollout, advantages
from cprl.learners.settings import LOLASettings
from cprl.learners.transitions import LaneTurn
from cprl.networks.finite import finite_lanes
from cprl.networks.stacked import lane_state, stack_lanes
from cprl.objectives import LOLADiCELoss, dice_objective
from cprl.objectives.functional import total


class Members(nn.ModuleList):
    """One network of each of S members, with the parameters of R replicas; lane = replica x S + member."""

    def forward(self, observation: Tensor) -> Tensor:
        """[R, .., S, *shape] to [R, .., S, outputs]."""
        first: Any = self[0]
        seen = observation.unbind(-1 - first.observation_dims)
        return torch.stack([network(of_member) for network, of_member in zip(self, seen, strict=True)], -2)

    def outputs(self, observation: Tensor, *recurrent: Tensor, part: int = 0) -> Tensor:
        """[R x S, k, *shape] to [R x S, k, outputs]; there is one part, 0."""
        by_replica = observation.reshape(-1, len(self), *observation.shape[1:]).transpose(1, 2)
        return self.forward(by_replica).transpose(1, 2).flatten(0, 1)

    def network_state(self, lane: int) -> dict[str, Tensor]:
        replica, member = divmod(lane, len(self))
        return lane_state(self[member], replica)


class LOLANetworks(nn.Module):
    """The actors and critics of all teams, and their optimisers.

    Args:
        networks: `AgentNetworks` of "actor" and "critic" for each lane, replica by replica.
        make_loss: makes the loss, a `LOLALoss` or `LOLADiCELoss`, from an `nn.ModuleList` of the members'
            networks.
        members: their number S.
    """

    loss: Any
    update: Final = "stacked"
    """How its loss sees the replicas, see `cprl.learners.networks.Update`."""

    def __init__(
        self,
        networks: Sequence[Any],
        make_loss: Callable[[Any], LossModule],
        settings: LOLASettings,
        *,
        members: int,
    ) -> None:
        super().__init__()
        self.settings = settings
        stacks: list[Any] = [stack_lanes(networks[member::members]) for member in range(members)]
        self.actors, self.critics = (
            Members([stack[name] for stack in stacks]) for name in ("actor", "critic")
        )
        self.players = deepcopy(self.actors)
        loss = make_loss(nn.ModuleList(stacks))
        self.ahead = deepcopy(self.actors) if isinstance(loss, LOLADiCELoss) else None
        object.__setattr__(self, "loss", loss)  # no submodule: its weights are those of the actors
        self.rule = UpdateRule.of(settings)
        of_critics = UpdateRule(learning_rate=settings.critic_learning_rate)
        self.optimizers = [
            torch_optimizer(self.rule, self.actors.parameters(), fused=None),
            torch_optimizer(of_critics, self.critics.parameters(), fused=None),
        ]

    def outputs(self, observation: Tensor, *recurrent: Tensor, part: int = 0) -> Tensor:
        """The outputs of actors, part 0, or critics, with their present weights, [R x S, k, ...]."""
        return (self.actors, self.critics)[part].outputs(observation)

    def playing(self, *seen: Tensor) -> Tensor:
        """The outputs by which members act in training."""
        return self.players.outputs(*seen)

    def network_state(self, lane: int) -> dict[str, Tensor]:
        """Copies of the present weights of an actor."""
        return self.actors.network_state(lane)

    def play(self, member: int | None) -> None:
        """From now on all act by their present weights; with a member, the others by those ahead."""
        for number, network in enumerate(self.players):
            weights = self.actors if member in (None, number) or self.ahead is None else self.ahead
            network.load_state_dict(weights[number].state_dict())

    def learn(self, draw: Draw) -> Tensor:
        """Takes a step of all policies, then `critic_epochs` of the critics; returns each member's loss, [L].

        The batch are rollouts [R, P, W, T] of `LOLARollouts`. A loss is the mean discounted return of the
        pieces of rollouts of the present weights, negative.
        """
        batch = draw.gather(draw.columns)
        rollouts = batch.exclude("target", "reward")
        self.update_policies(rollouts.flatten(1, 2) if self.ahead is None else rollouts)
        for _ in range(self.settings.critic_epochs):
            self.update_critics(batch["observation"].flatten(1, 2), batch["target"].flatten(1, 2))
        self.play(None)
        judged = batch[:, : 2 if self.ahead is None else 1]
        nothing = torch.zeros_like(judged["reward"])
        returns = dice_objective(nothing, judged["reward"], gamma=self.settings.gamma, done=judged["done"])
        return -returns.mean((1, 2)).flatten()

    def look_ahead(self, rollouts: TensorDict) -> None:
        """Puts the weights ahead to those after a naive step, from rollouts [R, B, T] of the present ones."""
        assert isinstance(self.loss, LOLADiCELoss)
        assert self.ahead is not None
        pairs = zip(self.actors.parameters(), self.ahead.parameters(), strict=True)
        then = {value.data_ptr(): ahead for value, ahead in pairs}
        for member, table in enumerate(self.loss.look_ahead(rollouts)):
            present = self.loss.actors_params.get(str(member))
            for key, value in table.items(True, True):
                then[present.get(key).data_ptr()].data.copy_(value)

    def update_policies(self, rollouts: TensorDict) -> None:
        policies, _ = self.optimizers
        policies.zero_grad()
        loss: Any = total(self.loss(rollouts), self.loss)
        loss.backward()
        if self.rule.max_grad_norm is not None:
            for network in self.actors:
                weights = list(network.parameters())
                gradients = [weight.grad for weight in weights if weight.grad is not None]
                clipped = clip_by_norm(gradients, self.rule.max_grad_norm)
                for weight, slope in zip(weights, clipped, strict=True):
                    weight.grad = slope
        policies.step()

    def update_critics(self, observation: Tensor, target: Tensor) -> None:
        """One step of all critics along their mean squared errors, from observations [R, B, T, S, *shape] and
        the values wanted, [R, B, T, S, 1]."""
        _, critics = self.optimizers
        critics.zero_grad()
        (self.critics(observation) - target).square().mean((1, 2)).sum().backward()
        critics.step()

    def finite(self) -> Tensor:
        """Whether the weights and moments of each member are finite, bool [R x S]."""
        states = {weight: state for optimizer in self.optimizers for weight, state in optimizer.state.items()}
        stacks = [self.actors, self.critics, self.players, *([] if self.ahead is None else [self.ahead])]
        sound = []
        for member in range(len(self.actors)):
            weights = [weight for stack in stacks for weight in stack[member].parameters()]
            moments = [value for weight in weights for value in states.get(weight, {}).values() if value.ndim]
            sound.append(finite_lanes([*weights, *moments]))
        return torch.stack(sound, -1).flatten()

    def get_extra_state(self) -> list[dict[str, Any]]:
        """The state of both optimisers; part of `state_dict`."""
        return [optimizer.state_dict() for optimizer in self.optimizers]

    def set_extra_state(self, state: list[dict[str, Any]]) -> None:
        for optimizer, moments in zip(self.optimizers, state, strict=True):
            optimizer.load_state_dict(moments)


class LOLARollouts:
    """Stores P rollouts of T turns of W worlds, one after the other, and then gives them as one batch.

    With a `LOLALoss` they are two, of the present weights, which are its two independent batches. With a
    `LOLADiCELoss` they are 1 + S: one of the present weights; then for each member one in which the others
    act by their weights ahead. Networks, evaluation and checkpoints have the present weights throughout.

    Args:
        rollouts: P.
    """

    sequence_steps: Final = 1

    def __init__(self, lanes: Lanes, settings: LOLASettings, network: nn.Module, *, rollouts: int) -> None:
        refuse_other_parts(network)
        self.lanes, self.settings, self.rollouts = lanes, settings, rollouts
        self.form = lanes.form()
        self.rollout = Rollout(lanes, settings.rollout_steps, self.form, rollouts)
        self._phase = 0

    def write(self, turn: Turn, lane_turn: LaneTurn) -> None:
        """Stores a turn, as all agents had it, and as these lanes did."""
        self.rollout.refuse_full()
        self.rollout.write(lane_turn, self._phase)

    def due(self, networks: LOLANetworks) -> Iterator[Draw]:
        """All rollouts, after the last one. After the others the next one may be of weights ahead."""
        if not self.rollout.is_full:
            return
        self.rollout.size, self._phase = 0, self._phase + 1
        if self._phase == self.rollouts:
            self._phase = 0
            yield Draw.of(self.batch(networks, self.rollouts))
        elif networks.ahead is not None:
            if self._phase == 1:
                present = self.batch(networks, 1)
                networks.look_ahead(present.exclude("target", "reward").flatten(1, 2))
            networks.play(self._phase - 1)

    @torch.no_grad()
    def batch(self, networks: LOLANetworks, rollouts: int) -> TensorDict:
        """The first rollouts, [R, P, W, T], of entries [.., S, ...]: with advantages, and under "target" what
        critics should say, [.., S, 1]."""
        size = self.lanes.replicas, len(self.lanes.agents)
        columns = {
            name: field[:rollouts].view(rollouts, *size, *field.shape[2:]).movedim((1, 2), (0, 4))
            for name, field in self.rollout.fields.items()
        }
        critics = networks.critics
        options: dict[str, Any] = {"settings": self.settings, "over": (2, 3), "time_dim": 3}
        value, following = critics(columns["observation"]), critics(columns["next_observation"])
        advantage, target = advantages(columns, value, following, **options)
        entries = {name: columns[name] for name in ("observation", "action", "reward")}
        entries |= {"advantage": advantage, "target": target, "done": columns["done"][..., :1]}
        return TensorDict(entries, columns["reward"].shape[:4])

    def values(self, networks: LOLANetworks, turn: Turn) -> Tensor:
        """What critics say of the state after a turn, [L, W, 1]."""
        return networks.critics.outputs(self.lanes.seen_next(turn))

    def cut(self, networks: LOLANetworks) -> None:
        """Drops the rollouts that a training left unfinished."""
        self.rollout.size = self._phase = 0
        networks.play(None)

    def state_dict(self) -> dict[str, Any]:
        return {**self.rollout.state_dict(), "phase": self._phase}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.rollout.load_state_dict(state)
        self._phase = int(state["phase"])
