"""The memory and the networks of LOLA teams, whose members anticipate how the others learn."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from typing import Any, Final

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.objectives import LossModule

from cprl.keys import Turn
from cprl.learners.draw import Draw
from cprl.learners.lanes import Lanes, outputs_by_agent
from cprl.learners.optimizers import UpdateRule, clip_by_norm, torch_optimizer
from cprl.learners.refusals import refuse_other_networks
from cprl.learners.rollouts import Rollout, advantages
from cprl.learners.settings import LOLASettings
from cprl.learners.transitions import LaneTurn
from cprl.networks.finite import finite_lanes
from cprl.networks.stacked import lane_state, stack_lanes
from cprl.objectives import LOLADiCELoss, dice_objective
from cprl.objectives.functional import total


class Members(nn.ModuleList):
    """A network for each of S members, each with the parameters of all R replicas.

    A lane is one member of one replica, lane = replica x S + member.
    """

    def forward(self, observation: Tensor) -> Tensor:
        """Map the observations of members, [R, .., S, *shape], to their outputs, [R, .., S, A]."""
        first: Any = self[0]
        by_member = observation.unbind(-1 - first.observation_dims)
        return torch.stack([network(entry) for network, entry in zip(self, by_member, strict=True)], -2)

    def outputs(self, observation: Tensor) -> Tensor:
        """Map the observations of lanes, [R x S, k, *shape], to their outputs, [R x S, k, A]."""
        outputs: Tensor = outputs_by_agent(self.forward, len(self))(observation)
        return outputs

    def network_state(self, lane: int) -> dict[str, Tensor]:
        """Return copies of the weights of a lane, as the state dict of its network."""
        replica, member = divmod(lane, len(self))
        return lane_state(self[member], replica)


class LOLANetworks(nn.Module):
    """The actors and critics of all teams, with their loss and optimisers.

    Actors exist up to three times: `actors` have the current weights, `players` are what members act with in
    training, and `ahead`, for DiCE, have the weights after the learning step that the others are expected to
    take.

    Args:
        networks: `AgentNetworks` of "actor" and "critic" for each lane, replica by replica.
        make_loss: makes the loss, a `LOLALoss` or `LOLADiCELoss`, from an `nn.ModuleList` of the members'
            networks.
        members: the number of members S.
    """

    loss: Any
    update: Final = "stacked"
    """How its loss is computed for all replicas, see `cprl.learners.networks.Update`."""

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
        stacks: list[Any] = [stack_lanes(networks[agent::members]) for agent in range(members)]
        self.actors = Members([stack["actor"] for stack in stacks])
        self.critics = Members([stack["critic"] for stack in stacks])
        self.players = deepcopy(self.actors)
        loss = make_loss(nn.ModuleList(stacks))
        self.ahead = deepcopy(self.actors) if isinstance(loss, LOLADiCELoss) else None
        object.__setattr__(self, "loss", loss)  # no submodule: its weights are those of the actors
        self.rule = UpdateRule.of(settings)
        critic_rule = UpdateRule(learning_rate=settings.critic_learning_rate)
        self.optimizers = [
            torch_optimizer(self.rule, self.actors.parameters(), fused=None),
            torch_optimizer(critic_rule, self.critics.parameters(), fused=None),
        ]

    def outputs(self, observation: Tensor) -> Tensor:
        """Return the outputs of actors with their current weights, [R x S, k, A]."""
        return self.actors.outputs(observation)

    def playing(self, observation: Tensor) -> Tensor:
        """Return the outputs by which members act in training, [R x S, k, A]."""
        return self.players.outputs(observation)

    def network_state(self, lane: int) -> dict[str, Tensor]:
        """Return copies of the current weights of the actor of a lane."""
        return self.actors.network_state(lane)

    def play(self, learning_member: int | None) -> None:
        """Set the weights by which members act from now on.

        Args:
            learning_member: the member that acts by its current weights, while the others act by those ahead;
                None if all act by their current weights.
        """
        for member, player in enumerate(self.players):
            acts_by_current = learning_member in (None, member)
            source = self.actors if self.ahead is None or acts_by_current else self.ahead
            player.load_state_dict(source[member].state_dict())

    def learn(self, draw: Draw) -> Tensor:
        """Take one step of all policies, then `critic_epochs` steps of the critics; return the losses, [L].

        The batch has the rollouts of `LOLARollouts`, [R, P, W, T]. The loss of a member is its negative mean
        discounted return in the segments of the rollouts that all played with their current weights.
        """
        batch = draw.gather(draw.columns)
        rollouts = batch.exclude("target", "reward")
        policy_rollouts = rollouts.flatten(1, 2) if self.ahead is None else rollouts
        self.update_policies(policy_rollouts)
        for _ in range(self.settings.critic_epochs):
            self.update_critics(batch["observation"].flatten(1, 2), batch["target"].flatten(1, 2))
        self.play(None)
        current = batch[:, : 2 if self.ahead is None else 1]
        zeros = torch.zeros_like(current["reward"])
        returns = dice_objective(zeros, current["reward"], gamma=self.settings.gamma, done=current["done"])
        return -returns.mean((1, 2)).flatten()

    def look_ahead(self, rollouts: TensorDict) -> None:
        """Set the weights ahead to those after a naive learning step of all members.

        Args:
            rollouts: [R, B, T], played by the current weights.
        """
        assert isinstance(self.loss, LOLADiCELoss)
        assert self.ahead is not None
        # The loss names weights otherwise than the actors do, so they are matched by their addresses.
        pairs = zip(self.actors.parameters(), self.ahead.parameters(), strict=True)
        ahead_by_address = {current.data_ptr(): ahead for current, ahead in pairs}
        for member, new_weights in enumerate(self.loss.look_ahead(rollouts)):
            loss_weights = self.loss.actors_params.get(str(member))
            for key, value in new_weights.items(True, True):
                ahead_by_address[loss_weights.get(key).data_ptr()].data.copy_(value)

    def update_policies(self, rollouts: TensorDict) -> None:
        """Take one step of all policies along LOLA's gradient, from rollouts [R, .., B, T]."""
        policies, _ = self.optimizers
        policies.zero_grad()
        loss: Any = total(self.loss(rollouts), self.loss)
        loss.backward()
        if self.rule.max_grad_norm is not None:
            for network in self.actors:
                weights = list(network.parameters())
                gradients = [weight.grad for weight in weights if weight.grad is not None]
                clipped = clip_by_norm(gradients, self.rule.max_grad_norm)
                for weight, gradient in zip(weights, clipped, strict=True):
                    weight.grad = gradient
        policies.step()

    def update_critics(self, observation: Tensor, target: Tensor) -> None:
        """Take one step of all critics along their mean squared errors, from observations [R, B, T, S,
        *shape] and target values [R, B, T, S, 1]."""
        _, critics = self.optimizers
        critics.zero_grad()
        (self.critics(observation) - target).square().mean((1, 2)).sum().backward()
        critics.step()

    def finite(self) -> Tensor:
        """Return for each lane whether its weights and optimiser state are finite, bool [R x S]."""
        states = {weight: state for optimizer in self.optimizers for weight, state in optimizer.state.items()}
        stacks = [stack for stack in self.children() if isinstance(stack, Members)]
        are_finite = []
        for agent in range(len(self.actors)):
            weights = [weight for stack in stacks for weight in stack[agent].parameters()]
            moments = [value for weight in weights for value in states.get(weight, {}).values() if value.ndim]
            are_finite.append(finite_lanes([*weights, *moments]))
        return torch.stack(are_finite, -1).flatten()

    def get_extra_state(self) -> list[dict[str, Any]]:
        """Return the states of both optimisers; part of `state_dict`."""
        return [optimizer.state_dict() for optimizer in self.optimizers]

    def set_extra_state(self, state: list[dict[str, Any]]) -> None:
        for optimizer, moments in zip(self.optimizers, state, strict=True):
            optimizer.load_state_dict(moments)


class LOLARollouts:
    """A memory that stores P rollouts of T turns of W worlds, one after the other, and yields them as one
    batch.

    `LOLALoss` needs two rollouts by the current weights, its two independent batches. `LOLADiCELoss` needs
    1 + S rollouts: one by the current weights, and one for each member in which the others act by their
    weights ahead. Stored networks, evaluations and checkpoints always have the current weights.

    Args:
        rollouts: the number of rollouts P.
    """

    def __init__(self, lanes: Lanes, settings: LOLASettings, network: nn.Module, *, rollouts: int) -> None:
        refuse_other_networks(network)
        self.lanes = lanes
        self.settings = settings
        self.rollouts = rollouts
        self.form = lanes.form()
        self.rollout = Rollout(lanes, settings.rollout_steps, self.form, rollouts)
        self._phase = 0
        """The index of the current rollout, 0 to P - 1."""

    def write(self, turn: Turn, lane_turn: LaneTurn) -> None:
        """Store a turn; `cprl.learners.learner.Memory.write` says the arguments."""
        self.rollout.write(lane_turn, self._phase)

    def due(self, networks: LOLANetworks) -> Iterator[Draw]:
        """Yield all rollouts when the last one is full; when another one is full, set the weights by which
        members play the next one."""
        if not self.rollout.is_full:
            return
        self.rollout.size = 0
        self._phase += 1
        if self._phase == self.rollouts:
            self._phase = 0
            yield Draw.of(self.batch(networks, self.rollouts))
        elif networks.ahead is not None:
            if self._phase == 1:
                rollout = self.batch(networks, 1)
                networks.look_ahead(rollout.exclude("target", "reward").flatten(1, 2))
            networks.play(self._phase - 1)

    @torch.no_grad()
    def batch(self, networks: LOLANetworks, rollouts: int) -> TensorDict:
        """Return the first `rollouts` rollouts, [R, P, W, T], with entries of members [.., S, ...]: also
        "advantage", and "target", the targets of the critics, [.., S, 1]."""
        size = self.lanes.replicas, len(self.lanes.agents)
        columns = {
            name: field[:rollouts].view(rollouts, *size, *field.shape[2:]).movedim((1, 2), (0, 4))
            for name, field in self.rollout.fields.items()
        }
        critics = networks.critics
        value = critics(columns["observation"])
        next_value = critics(columns["next_observation"])
        advantage, target = advantages(
            columns, value, next_value, settings=self.settings, over=(2, 3), time_dim=3
        )
        entries = {name: columns[name] for name in ("observation", "action", "reward")}
        entries |= {"advantage": advantage, "target": target, "done": columns["done"][..., :1]}
        return TensorDict(entries, columns["reward"].shape[:4])

    def values(self, networks: LOLANetworks, turn: Turn) -> Tensor:
        """Return the critics' value of the state after a turn, [L, W, 1]."""
        return networks.critics.outputs(self.lanes.next_observations(turn))

    def cut(self, networks: LOLANetworks) -> None:
        """Drop the rollouts that a training left unfinished."""
        self.rollout.size = self._phase = 0
        networks.play(None)

    def state_dict(self) -> dict[str, Any]:
        return {**self.rollout.state_dict(), "phase": self._phase}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.rollout.load_state_dict(state)
        self._phase = int(state["phase"])
