"""LOLALearner: teams whose members learn with the others' learning in view."""

from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from cprl.keys import Turn
from cprl.learners.base import LearningAgents
from cprl.learners.engine import UpdateRule, shortened, torch_optimizer
from cprl.learners.lanes import Acts, LaneLearner, Method
from cprl.learners.rollouts import Rollout, advantages, refuse_other_parts
from cprl.learners.settings import LOLASettings
from cprl.networks.finite import finite_lanes
from cprl.networks.stacked import lane_state, stack_lanes
from cprl.objectives import LOLADiCELoss, dice_objective
from cprl.objectives.functional import total
from cprl.policies.rng import EXPLORATION, WEIGHTS


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
    """

    loss: Any

    def __init__(self, networks: Sequence[Any], method: Method, *, members: int) -> None:
        super().__init__()
        settings: LOLASettings = method.settings
        stacks: list[Any] = [stack_lanes(networks[member::members]) for member in range(members)]
        self.actors, self.critics = (
            Members([stack[name] for stack in stacks]) for name in ("actor", "critic")
        )
        self.playing = deepcopy(self.actors)
        loss = method.make_loss(nn.ModuleList(stacks))
        self.ahead = deepcopy(self.actors) if isinstance(loss, LOLADiCELoss) else None
        object.__setattr__(self, "loss", loss)  # no submodule: its weights are those of the actors
        self.rule = UpdateRule.of(settings)
        of_critics = UpdateRule(learning_rate=settings.critic_learning_rate)
        self.optimizers = [
            torch_optimizer(self.rule, self.actors.parameters(), fused=None),
            torch_optimizer(of_critics, self.critics.parameters(), fused=None),
        ]

    def play(self, member: int | None) -> None:
        """From now on all act by their present weights; with a member, the others by those ahead."""
        for number, network in enumerate(self.playing):
            weights = self.actors if member in (None, number) or self.ahead is None else self.ahead
            network.load_state_dict(weights[number].state_dict())

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
                for weight, slope in zip(weights, shortened(gradients, self.rule.max_grad_norm), strict=True):
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
        """Whether the weights and moments of each member are finite, bool [R, S]."""
        states = {weight: state for optimizer in self.optimizers for weight, state in optimizer.state.items()}
        stacks = [self.actors, self.critics, self.playing, *([] if self.ahead is None else [self.ahead])]
        sound = []
        for member in range(len(self.actors)):
            weights = [weight for stack in stacks for weight in stack[member].parameters()]
            moments = [value for weight in weights for value in states.get(weight, {}).values() if value.ndim]
            sound.append(finite_lanes([*weights, *moments]))
        return torch.stack(sound, -1)

    def get_extra_state(self) -> list[dict[str, Any]]:
        """The state of both optimisers; part of `state_dict`."""
        return [optimizer.state_dict() for optimizer in self.optimizers]

    def set_extra_state(self, state: list[dict[str, Any]]) -> None:
        for optimizer, moments in zip(self.optimizers, state, strict=True):
            optimizer.load_state_dict(moments)


class LOLALearner(LaneLearner):
    """R teams of S agents that learn with opponent-learning awareness, from rollouts of T turns of W worlds.

    An update takes P rollouts, one after the other in the worlds of the training. With `LOLALoss` they are
    two, of the present weights, which are its two independent batches. With `LOLADiCELoss` they are 1 + S:
    one of the present weights; then for each member one in which the others act by their weights ahead.
    Networks, evaluation and checkpoints have the present weights throughout.

    Each replica learns exactly as it would alone. Updates are not compiled.

    Args:
        who: the members, two or more; `start_from` is that of actors, critics are new.
        method: makes a member's "actor" and "critic", and the loss, a `LOLALoss` or `LOLADiCELoss`, from an
            `nn.ModuleList` of the members' networks.
        compile: whether torch compiles acting.
    """

    settings: LOLASettings
    engine: LOLANetworks

    def __init__(self, who: LearningAgents, method: Method, *, compile: bool = True) -> None:
        super().__init__(who, method)
        networks = self._lanes.new_networks(WEIGHTS)
        refuse_other_parts(networks[0])
        members = len(self.agents)
        self.engine = LOLANetworks(networks, method, members=members)
        self._looks_ahead = isinstance(self.engine.loss, LOLADiCELoss)
        self.rollouts = 1 + members if self._looks_ahead else 2
        """The number P of rollouts that an update takes."""
        self.actor = self._lanes.actor(self.engine.playing, EXPLORATION, worlds=self.worlds, compile=compile)
        self._rollouts = Rollout(self._lanes, self.rollout_steps, self.rollouts)
        self._phase = 0

    @property
    def present(self) -> Acts:
        return self.engine.actors

    @property
    def rollout_steps(self) -> int:
        return self.settings.rollout_steps

    def begin(self) -> None:
        """Drops the rollouts that an earlier training left unfinished; see `Learner`."""
        self._rollouts.size, self._phase = 0, 0
        self.engine.play(None)

    def store(self, batch: TensorDictBase | Turn) -> None:
        turn = Turn.of(batch)
        self._rollouts.refuse_full()
        self._rollouts.write(self._lanes.turn(turn, self._wanted(turn)), self._phase)
        self.steps += self.worlds

    def update(self) -> Tensor | None:
        """Updates after the last rollout; returns each member's loss, [R, S], or None if there is no update.

        The loss is the mean discounted return of the pieces of rollouts of the present weights, negative.
        """
        if not self._rollouts.is_full:
            return None
        self._rollouts.size, self._phase = 0, self._phase + 1
        if self._phase < self.rollouts:
            if self._looks_ahead:
                self._play_ahead(self._phase - 1)
            return None
        self._phase = 0
        observation, rollouts, target = self._batch(self.rollouts)
        losses = self._losses(1 if self._looks_ahead else 2)
        self.engine.update_policies(rollouts if self._looks_ahead else rollouts.flatten(1, 2))
        for _ in range(self.settings.critic_epochs):
            self.engine.update_critics(observation, target)
        self.engine.play(None)
        return losses

    def _play_ahead(self, member: int) -> None:
        """The next rollout is that of a member whose others have looked ahead."""
        if member == 0:
            _, rollouts, _ = self._batch(1)
            self.engine.look_ahead(rollouts.flatten(1, 2))
        self.engine.play(member)

    def _columns(self, rollouts: int) -> dict[str, Tensor]:
        """Fields of the first rollouts, [R, P, W, T, S, ...]."""
        size = self.replicas, len(self.agents)
        return {
            name: field[:rollouts].view(rollouts, *size, *field.shape[2:]).movedim((1, 2), (0, 4))
            for name, field in self._rollouts.fields.items()
        }

    def _batch(self, rollouts: int) -> tuple[Tensor, TensorDict, Tensor]:
        """Of the first rollouts: observations [R, P x W, T, S, *shape], the input of the loss [R, P, W, T],
        and what critics should say, [R, P x W, T, S, 1]."""
        columns = self._columns(rollouts)
        critics = self.engine.critics
        options: dict[str, Any] = {"settings": self.settings, "over": (2, 3), "time_dim": 3}
        with torch.no_grad():
            value, following = critics(columns["observation"]), critics(columns["next_observation"])
            advantage, target = advantages(columns, value, following, **options)
        entries = {
            "observation": columns["observation"],
            "action": columns["action"],
            "advantage": advantage,
            "done": columns["done"][..., :1],
        }
        size = (self.replicas, rollouts, self.worlds, self.rollout_steps)
        return columns["observation"].flatten(1, 2), TensorDict(entries, size), target.flatten(1, 2)

    def _losses(self, rollouts: int) -> Tensor:
        """The negative mean returns of the first rollouts, [R, S]."""
        columns = self._columns(rollouts)
        reward, done = columns["reward"], columns["done"][..., :1]
        returns = dice_objective(torch.zeros_like(reward), reward, gamma=self.settings.gamma, done=done)
        return -returns.mean((1, 2))

    def values(self, batch: TensorDictBase | Turn) -> Tensor:
        with torch.no_grad():
            expected = self.engine.critics.outputs(self._lanes.seen_next(Turn.of(batch)))
        return self._lanes.by_world(expected)

    def state_dict(self) -> dict[str, Any]:
        rollouts = {"rollouts": self._rollouts.fields, "size": self._rollouts.size, "phase": self._phase}
        return {**super().state_dict(), **rollouts}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        super().load_state_dict(state)
        self._rollouts.load(state["rollouts"], state["size"])
        self._phase = int(state["phase"])
