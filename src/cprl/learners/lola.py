"""LOLALearner: teams whose members learn with the others' learning in view."""

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from typing import Any, Final

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import LossModule
from torchrl.objectives.value.functional import generalized_advantage_estimate

from cprl.learners.engine import (
    BETA_1,
    BETA_2,
    WITH_MEAN,
    WITH_SQUARE,
    UpdateRule,
    change_weights,
    total,
)
from cprl.learners.lanes import WEIGHTS, Acts, LaneLearner, LearningAgents, Method
from cprl.learners.rollouts import refuse_full, refuse_other_parts, rollout_fields, write_turn
from cprl.learners.settings import LOLASettings
from cprl.learners.transitions import wanted_in
from cprl.networks.finite import finite_lanes
from cprl.networks.stacked import lane_state, stack_lanes
from cprl.objectives import LOLADiCELoss, dice_objective

_SMALL: Final = 1e-8


class Steps:
    """An optimiser of the parameters of S members, [R, ...] each; it clips the gradients of each member of
    each replica."""

    def __init__(self, parameters: Sequence[Sequence[nn.Parameter]], rule: UpdateRule) -> None:
        self._parameters, self._rule, self.count = parameters, rule, 0
        name = rule.optimizer
        self.means = [[torch.zeros_like(value) for value in of] for of in parameters if name in WITH_MEAN]
        self.squares = [[torch.zeros_like(value) for value in of] for of in parameters if name in WITH_SQUARE]

    def descend(self, loss: Tensor) -> None:
        """One step along the gradient of a sum over members and replicas."""
        self.count += 1
        flat = [value for of in self._parameters for value in of]
        slopes = list(torch.autograd.grad(loss, flat))
        for member, of in enumerate(self._parameters):
            gradients, slopes = slopes[: len(of)], slopes[len(of) :]
            change_weights(
                self._rule,
                [value.data for value in of],
                gradients,
                self.means[member] if self.means else (),
                self.squares[member] if self.squares else (),
                step_size=gradients[0].new_tensor(self._rule.learning_rate / (1 - BETA_1**self.count)),
                scale=gradients[0].new_tensor((1 - BETA_2**self.count) ** -0.5),
            )

    def moments(self, member: int) -> list[Tensor]:
        """What it keeps of a member, [R, ...] each."""
        return [value for of in (self.means, self.squares) if of for value in of[member]]

    def state_dict(self) -> dict[str, Any]:
        return {"count": self.count, "means": self.means, "squares": self.squares}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.count = int(state["count"])
        for name in ("means", "squares"):
            copy_all(getattr(self, name), state[name])


def copy_all(values: Sequence[Sequence[Tensor]], state: Sequence[Sequence[Tensor]]) -> None:
    """Copies the tensors of each member into its own, in place."""
    for of, others in zip(values, state, strict=True):
        for value, other in zip(of, others, strict=True):
            value.copy_(other)


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
        return torch.stack(
            [network(of_member) for network, of_member in zip(self.networks, seen, strict=True)], -2
        )

    def outputs(self, observation: Tensor, *recurrent: Tensor, part: int = 0) -> Tensor:
        """[R x S, k, *shape] to [R x S, k, outputs]; there is one part, 0."""
        by_replica = observation.reshape(-1, len(self.networks), *observation.shape[1:]).transpose(1, 2)
        return self.of_members(by_replica).transpose(1, 2).flatten(0, 1)

    def network_state(self, lane: int) -> dict[str, Tensor]:
        replica, member = divmod(lane, len(self.networks))
        return lane_state(self.networks[member], replica)

    def parameters(self) -> list[list[nn.Parameter]]:
        """The parameters of each member, [R, ...] each."""
        return [list(network.parameters()) for network in self.networks]

    def copy_from(self, other: "MemberStacks", members: Sequence[int]) -> None:
        for member in members:
            pairs = zip(self.parameters()[member], other.parameters()[member], strict=True)
            for parameter, value in pairs:
                parameter.data.copy_(value.data)


class LOLANetworks:
    """The actors and critics of all teams, and their optimisers.

    Args:
        networks: `AgentNetworks` of "actor" and "critic" for each lane, replica by replica.
        make_loss: makes the loss from an `nn.ModuleList` of the members' networks.
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
            ([stack[name] for stack in stacks], [form[name] for form in forms])
            for name in ("actor", "critic")
        )
        self.acting, self.critics = MemberStacks(*actors), MemberStacks(*critics)
        self.playing = MemberStacks(deepcopy(actors[0]), actors[1])
        self.loss = make_loss(nn.ModuleList(stacks))
        looks = isinstance(self.loss, LOLADiCELoss)
        self.ahead = MemberStacks(deepcopy(actors[0]), actors[1]) if looks else None
        self.policy_steps = Steps(self.acting.parameters(), UpdateRule.of(settings))
        self.critic_steps = Steps(
            self.critics.parameters(), UpdateRule(learning_rate=settings.critic_learning_rate)
        )

    def play(self, member: int | None) -> None:
        """From now on all act by their present weights; with a member, the others by those ahead."""
        everyone = range(len(self.acting.networks))
        self.playing.copy_from(self.acting, [other for other in everyone if member in (None, other)])
        if member is not None and self.ahead is not None:
            self.playing.copy_from(self.ahead, [other for other in everyone if other != member])

    def look_ahead(self, rollouts: TensorDict) -> None:
        """Puts the weights ahead to those after a naive step, from rollouts [R, B, T] of the present ones."""
        assert isinstance(self.loss, LOLADiCELoss)
        assert self.ahead is not None
        for member, table in enumerate(self.loss.look_ahead(rollouts)):
            of_loss = self.loss.actors_params.get(str(member)).items(True, True)
            names = {value.data_ptr(): key for key, value in of_loss}
            pairs = zip(self.acting.parameters()[member], self.ahead.parameters()[member], strict=True)
            for parameter, then in pairs:
                then.data.copy_(table.get(names[parameter.data_ptr()]))

    def update_policies(self, rollouts: TensorDict) -> None:
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
        each = []
        for member in range(len(self.acting.networks)):
            weights = [value for stacks in self._stacks().values() for value in stacks.parameters()[member]]
            moments = [
                value for steps in (self.policy_steps, self.critic_steps) for value in steps.moments(member)
            ]
            each.append(finite_lanes([*weights, *moments]))
        return torch.stack(each, -1)

    def state_dict(self) -> dict[str, Any]:
        return {
            **{name: _data(stacks) for name, stacks in self._stacks().items()},
            "policy_steps": self.policy_steps.state_dict(),
            "critic_steps": self.critic_steps.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        for name, stacks in self._stacks().items():
            copy_all(_data(stacks), state[name])
        self.policy_steps.load_state_dict(state["policy_steps"])
        self.critic_steps.load_state_dict(state["critic_steps"])

    def _stacks(self) -> dict[str, MemberStacks]:
        stacks = {
            "actors": self.acting,
            "critics": self.critics,
            "playing": self.playing,
            "ahead": self.ahead,
        }
        return {name: stack for name, stack in stacks.items() if stack is not None}


def _data(stacks: MemberStacks) -> list[list[Tensor]]:
    return [[value.data for value in of] for of in stacks.parameters()]


class LOLALearner(LaneLearner):
    """R teams of S agents that learn with opponent-learning awareness, from rollouts of T steps.

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
        settings: LOLASettings = method.settings
        networks = self._lanes.new_networks(WEIGHTS)
        refuse_other_parts(networks[0])
        members = len(self.agents)
        self.engine = LOLANetworks(networks, members=members, make_loss=method.make_loss, settings=settings)
        self._looks_ahead = isinstance(self.engine.loss, LOLADiCELoss)
        self.rollouts = 1 + members if self._looks_ahead else 2
        """The number P of rollouts that an update takes."""
        self.actor = self._lanes.actor(self.engine.playing, compile=compile)
        self._rollouts = rollout_fields(self._lanes, (self.rollouts, settings.rollout_steps))
        self._size, self._phase = 0, 0

    @property
    def present(self) -> Acts:
        return self.engine.acting

    @property
    def rollout_steps(self) -> int:
        return self.settings.rollout_steps

    def begin(self) -> None:
        """Drops the rollouts that an earlier training left unfinished; see `Learner`."""
        self._size, self._phase = 0, 0
        self.engine.play(None)

    def store(self, batch: TensorDictBase) -> None:
        refuse_full(self._size, self.rollout_steps)
        turn = self._lanes.rollout_turn(batch, wanted_in(self.wants, batch))
        write_turn(self._rollouts, (self._phase, self._size), turn)
        self._size += 1
        self.steps += 1

    def update(self) -> Tensor | None:
        """Updates after the last rollout; returns each member's loss, [R, S], or None if there is no update.

        The loss is the mean discounted return of the pieces of rollouts of the present weights, negative.
        """
        if self._size < self.rollout_steps:
            return None
        self._size, self._phase = 0, self._phase + 1
        if self._phase < self.rollouts:
            if self._looks_ahead:
                self._play_ahead(self._phase - 1)
            return None
        self._phase = 0
        observation, rollouts, target = self._batch(self.rollouts)
        losses = self._losses(1 if self._looks_ahead else 2)
        self.engine.update_policies(rollouts.unsqueeze(2) if self._looks_ahead else rollouts)
        for _ in range(self.settings.critic_epochs):
            self.engine.update_critics(observation, target)
        self.engine.play(None)
        return losses

    def _play_ahead(self, member: int) -> None:
        """The next rollout is that of a member whose others have looked ahead."""
        if member == 0:
            _, rollouts, _ = self._batch(1)
            self.engine.look_ahead(rollouts)
        self.engine.play(member)

    def _columns(self, rollouts: int) -> dict[str, Tensor]:
        size = self.replicas, len(self.agents)
        return {
            name: field[:rollouts].reshape(rollouts, -1, *size, *field.shape[3:]).movedim(2, 0)
            for name, field in self._rollouts.items()
        }

    def _batch(self, rollouts: int) -> tuple[Tensor, TensorDict, Tensor]:
        """Of the first rollouts: observations [R, P, T, S, *shape], the input of the loss [R, P, T], and what
        critics should say, [R, P, T, S, 1]."""
        columns = self._columns(rollouts)
        with torch.no_grad():
            critics = self.engine.critics
            advantage, target = generalized_advantage_estimate(
                self.settings.gamma,
                self.settings.gae_lambda,
                critics.of_members(columns["observation"]),
                critics.of_members(columns["next_observation"]),
                *(columns[name].unsqueeze(-1) for name in ("reward", "done", "terminated")),
                time_dim=2,
            )
        if self.settings.normalize_advantage:
            advantage = advantage - advantage.mean(2, keepdim=True)
            advantage = advantage / (advantage.std(2, keepdim=True) + _SMALL)
        entries = {
            "observation": columns["observation"],
            "action": columns["action"],
            "advantage": advantage,
            "done": columns["done"][..., :1],
        }
        size = (self.replicas, rollouts, self.rollout_steps)
        return columns["observation"], TensorDict(entries, size), target

    def _losses(self, rollouts: int) -> Tensor:
        """The negative mean returns of the first rollouts, [R, S]."""
        columns = self._columns(rollouts)
        reward, done = columns["reward"], columns["done"][..., :1]
        returns = dice_objective(torch.zeros_like(reward), reward, gamma=self.settings.gamma, done=done)
        return -returns.mean(1)

    def values(self, batch: TensorDictBase) -> Tensor:
        """The value that each member's critic gives to the state after a turn, [R, S]."""
        with torch.no_grad():
            expected = self.engine.critics.outputs(self._lanes.seen_next(batch))
        return expected.reshape(self.replicas, len(self.agents))

    def finite(self) -> Tensor:
        return self.engine.finite()

    def state_dict(self) -> dict[str, Any]:
        return {
            **super().state_dict(),
            "rollouts": self._rollouts,
            "size": self._size,
            "phase": self._phase,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        super().load_state_dict(state)
        for name, field in self._rollouts.items():
            field.copy_(state["rollouts"][name])
        self._size, self._phase = int(state["size"]), int(state["phase"])
