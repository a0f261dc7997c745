"""RolloutLearner: independent on-policy agents, all of them in one update."""

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import replace
from typing import Any, Final

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives.value.functional import generalized_advantage_estimate

from cprl.keys import Turn
from cprl.learners.base import LearningAgents
from cprl.learners.engine import COMPILED_STEPS, Engine, ListEngine, UpdateRule
from cprl.learners.lanes import LaneLearner, Lanes, Method
from cprl.learners.ring import steps_ahead
from cprl.learners.settings import LOLASettings, RolloutSettings
from cprl.learners.transitions import LaneTurn, refuse_other_dtype
from cprl.learners.trial import reads, refuse_other_advantages, trial_batch, trial_rollout
from cprl.networks.agent import AgentNetworks, parts_of
from cprl.networks.recurrent import state_shape_of
from cprl.policies.rng import EXPLORATION, SAMPLING, WEIGHTS, LaneRng
from cprl.system.compiling import Compiled

ACTOR, CRITIC = range(2)
"""Positions of the actor and the critic among an agent's networks."""

NAMES = "recurrent_state", "critic_recurrent_state"
"""The entries of the states before each step, of the actor and the critic, in the batches of losses."""

_SMALL: Final = 1e-8


def states_in(network: nn.Module) -> dict[str, tuple[int, ...]]:
    """The shapes of the states of actor and critic by their entries; empty for networks without."""
    parts = list(parts_of(network).items())[:2]
    shapes = [state_shape_of(part) for _, part in parts]
    if all(shape is None for shape in shapes):
        return {}
    for (name, _), shape in zip(parts, shapes, strict=True):
        if shape is None:
            raise ValueError(
                f'the "{name}" is not recurrent; allowed beside a network that is: a GRU or an LSTM'
            )
    return {name: shape for name, shape in zip(NAMES, shapes, strict=True) if shape is not None}


class States:
    """The states of recurrent actors and critics of L lanes in W worlds, from one rollout to the next.

    The actor's first state of a rollout is the one by which it acted; that of the critic, which does not act,
    is what it had after the rollout before. Gradients run through the `sequence` turns of a minibatch, which
    begin with the states that the rollout had there: the stored states of Kapturowski et al., "Recurrent
    Experience Replay in Distributed Reinforcement Learning" (2019).

    Args:
        sequence: consecutive turns T' of a minibatch.
    """

    def __init__(self, shapes: Mapping[str, tuple[int, ...]], lanes: Lanes, *, sequence: int) -> None:
        self._lanes, self._sequence, device = lanes, sequence, lanes.who.device
        size = len(lanes), lanes.worlds
        self._first = {name: torch.zeros(*size, *shape, device=device) for name, shape in shapes.items()}
        self._ended = torch.ones(size, dtype=torch.bool, device=device)
        """Whether the episode ended with the last turn of the rollout before."""

    def forget(self) -> None:
        """The next rollout begins with new episodes."""
        self._ended.fill_(True)

    def begin(self, turn: Turn) -> None:
        """Notes by which states agents act in the first turn of a rollout."""
        self._first[NAMES[ACTOR]].copy_(self._lanes.by_lane(self._lanes.states_in(turn)))

    def evaluate(
        self, engine: Engine, columns: Mapping[str, Tensor]
    ) -> tuple[Tensor, Tensor, Tensor, dict[str, Tensor]]:
        """The logits, values and next values of a full rollout, [L, W, T, ...], and what losses read besides:
        the states before each turn, and "is_init". Keeps the critic's states for the next rollout."""
        began, states = self._began(columns["done"]), {}
        logits, states[NAMES[ACTOR]], _ = self._in_order(engine, columns, began, ACTOR)
        value, states[NAMES[CRITIC]], after = self._in_order(engine, columns, began, CRITIC)
        next_value, _ = engine.outputs(columns["next_observation"], after, part=CRITIC)
        self._first[NAMES[CRITIC]].copy_(after[:, :, -1])
        self._ended.copy_(columns["done"][..., -1])
        is_init = began.clone()
        is_init[..., :: self._sequence] = True
        return logits, value, next_value, {**states, "is_init": is_init}

    def value_next(
        self, engine: Engine, columns: Mapping[str, Tensor], size: int, seen_next: Tensor
    ) -> Tensor:
        """The value of the state after the latest of `size` turns, 0 directly after a rollout, from the
        observations after it, [L, W, ...]."""
        after = self._first[NAMES[CRITIC]]
        if size:
            so_far = {name: column[:, :, :size] for name, column in columns.items()}
            _, _, each = self._in_order(engine, so_far, self._began(so_far["done"]), CRITIC)
            after = each[:, :, -1]
        value: Tensor = engine.outputs(seen_next, after, part=CRITIC)[0]
        return value

    def _began(self, done: Tensor) -> Tensor:
        """Whether an episode begins with a turn, bool [L, W, T]."""
        return torch.cat([self._ended.unsqueeze(-1), done[..., :-1]], -1)

    def _in_order(
        self, engine: Engine, columns: Mapping[str, Tensor], began: Tensor, part: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The outputs of a network, its states before each turn and after it, [L, W, T, ...]."""
        observation, first = columns["observation"], self._first[NAMES[part]]
        given = first.new_zeros(*observation.shape[:3], *first.shape[2:])
        given[:, :, 0] = torch.where(_like(began[..., 0], first), 0.0, first)
        is_init = began.clone()
        is_init[..., 0] = True
        outputs, after = engine.outputs(observation, given, is_init, part=part)
        begins, later = began[..., 1:], after[:, :, :-1]
        before = torch.cat([given[:, :, :1], torch.where(_like(begins, later), 0.0, later)], 2)
        return outputs, before, after

    def state_dict(self) -> dict[str, Tensor]:
        return {**self._first, "ended": self._ended}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        for name, value in self.state_dict().items():
            value.copy_(state[name])


class RolloutLearner(LaneLearner):
    """R x S independent agents that learn from the latest steps of their current policies.

    After T = `rollout_steps` turns of the W worlds the learner estimates advantages with TorchRL's GAE and
    updates for `epochs` epochs over all T x W steps. Each lane shuffles its own minibatches, and learns
    exactly as it would alone. Minibatches of recurrent networks are consecutive turns of one world, or, where
    they are larger than a rollout, the rollouts of several worlds; the update of more than `COMPILED_STEPS`
    turns is not compiled.

    Args:
        method: makes networks that are "actor" and "critic", see `cprl.algorithms.on_policy`.
    """

    settings: RolloutSettings

    def __init__(self, who: LearningAgents, method: Method, *, compile: bool = True) -> None:
        # Advantages, and so rewards, are those of each member of a team.
        super().__init__(who, replace(method, own_rewards=True))
        settings: RolloutSettings = method.settings
        networks = self._lanes.new_networks(WEIGHTS)
        refuse_other_parts(networks[0])
        self._state_shapes = shapes = states_in(networks[0])
        loss = method.make_loss(deepcopy(networks[0]))
        refuse_other_advantages(loss, settings)
        self._reads_logits = reads(loss, "logits")
        self._sequence = min(settings.minibatch_size, settings.rollout_steps)
        is_short = not shapes or self._sequence <= COMPILED_STEPS
        rule = UpdateRule.of(settings)
        self.engine = self._make_engine(networks, rule=rule, compile=compile and is_short)
        self._states = States(shapes, self._lanes, sequence=self._sequence) if shapes else None
        self.actor = self._lanes.actor(self.engine, EXPLORATION, worlds=self.worlds, compile=compile)
        compiles = compile and not isinstance(self.engine, ListEngine)
        self._both = Compiled(_outputs_of_both, what="rollouts are evaluated", enabled=compiles)
        steps = settings.rollout_steps * self.worlds
        self.rng = LaneRng(self._lanes.seeds(SAMPLING), steps, ahead=steps_ahead(steps))
        self._rollout = Rollout(self._lanes, settings.rollout_steps)

    def _trial(self, lanes: int) -> TensorDict:
        actions = self.spaces.actions
        transitions = trial_batch(lanes, self._lanes.form(), actions, device=self.who.device)
        return trial_rollout(
            transitions, actions=actions if self._reads_logits else None, states=self._state_shapes
        )

    @property
    def rollout_steps(self) -> int:
        return self.settings.rollout_steps

    def begin(self) -> None:
        """Drops the rollout that an earlier training left unfinished; see `Learner`."""
        self._rollout.size = 0
        if self._states is not None:
            self._states.forget()

    def store(self, batch: TensorDictBase | Turn) -> None:
        turn = Turn.of(batch)
        self._rollout.refuse_full()
        if self._states is not None and not self._rollout.size:
            self._states.begin(turn)
        self._rollout.write(self._lanes.turn(turn, self._wanted(turn)))
        self.steps += self.worlds

    def update(self) -> Tensor | None:
        """Runs all epochs over a full rollout; returns the mean losses [R, S], or None if it is not full."""
        if not self._rollout.is_full:
            return None
        batch = self._batch()
        losses = []
        for _ in range(self.settings.epochs):
            places = self._minibatches(self.rng.next()).to(batch["action"].device)
            losses += [self.engine.update_at(batch, place) for place in places]
        self._rollout.size = 0
        return self._lanes.by_agent(torch.stack(losses).mean(0))

    def _minibatches(self, numbers: Tensor) -> Tensor:
        """The steps of an epoch's minibatches, int64 [minibatches, L, size], from random numbers [L, W x T];
        of recurrent networks T' consecutive turns, [minibatches, L, T'], or several such sequences of each
        lane, [minibatches, L, sequences, T']."""
        size = self.settings.minibatch_size
        if self._states is None:
            return numbers.argsort(-1).view(len(numbers), -1, size).transpose(0, 1)
        turns = self._sequence
        sequences = numbers[:, ::turns].argsort(-1).view(len(numbers), -1, size // turns).transpose(0, 1)
        places = sequences.unsqueeze(-1) * turns + torch.arange(turns)
        return places.squeeze(2)

    def _batch(self) -> TensorDict:
        """The rollout with advantages, [L, W x T], under the keys of TorchRL's losses; advantages are
        normalised within each lane if the settings say so."""
        columns = self._rollout.fields
        with torch.no_grad():
            entries: dict[str, Tensor] = {}
            if self._states is not None:
                logits, value, next_value, entries = self._states.evaluate(self.engine, columns)
            else:
                logits, value, next_value = self._evaluated(columns)
            chances = logits.log_softmax(-1)
            over = tuple(range(1, value.ndim))
            options: dict[str, Any] = {"settings": self.settings, "over": over, "time_dim": 2}
            advantage, target = advantages(columns, value, next_value, **options)
        chosen = chances.gather(-1, columns["action"].unsqueeze(-1)).squeeze(-1)
        read = {
            "observation": columns["observation"],
            "action": columns["action"],
            "action_log_prob": chosen,
            "advantage": advantage,
            "value_target": target,
            "state_value": value,
            **({"logits": logits} if self._reads_logits else {}),
            **entries,
        }
        size = [self.lanes, self.worlds * self.rollout_steps]
        return TensorDict({name: entry.flatten(1, 2) for name, entry in read.items()}, size)

    def _evaluated(self, columns: Mapping[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """The logits, values and next values of a full rollout, [L, W, T, ...]."""
        seen, following = (columns[name].flatten(1, 2) for name in ("observation", "next_observation"))
        done = columns["done"]
        if self.worlds == 1:  # in one piece, since products of other shapes round in other ways
            logits, value = _outputs_of_both(self.engine, seen)
            next_value = self.engine.outputs(following, part=CRITIC)
        else:  # in pieces that stay in the processor's caches
            pieces = torch.split(seen, self.settings.minibatch_size, 1)
            given = [self._both((piece.shape, piece.dtype), self.engine, piece) for piece in pieces]
            logits, value = (torch.cat(each, 1) for each in zip(*given, strict=True))
            # What is seen after a turn is seen before the next one, but where an episode or the rollout ends.
            next_value, ends = value.roll(-1, 1), done.clone()
            ends[:, :, -1] = True
            place = _places(ends.flatten(1))
            lane = torch.arange(self.lanes, device=place.device)[:, None]
            next_value[lane, place] = self.engine.outputs(following[lane, place], part=CRITIC)
        by_turn = (entry.reshape(*done.shape, *entry.shape[2:]) for entry in (logits, value, next_value))
        logits, value, next_value = by_turn
        return logits, value, next_value

    def values(self, batch: TensorDictBase | Turn) -> Tensor:
        with torch.no_grad():
            seen = self._lanes.seen_next(Turn.of(batch))
            if self._states is None:
                expected: Tensor = self.engine.outputs(seen, part=CRITIC)
            else:
                columns = self._rollout.fields
                expected = self._states.value_next(self.engine, columns, self._rollout.size, seen)
        return self._lanes.by_world(expected)

    def state_dict(self) -> dict[str, Any]:
        return {
            **super().state_dict(),
            "rollout": self._rollout.fields,
            "size": self._rollout.size,
            "draws": self.rng.state_dict(),
            **({} if self._states is None else {"recurrent": self._states.state_dict()}),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        super().load_state_dict(state)
        self._rollout.load(state["rollout"], state["size"])
        self.rng.load_state_dict(state["draws"])
        if self._states is not None:
            self._states.load_state_dict(state["recurrent"])


def _outputs_of_both(engine: Engine, observation: Tensor) -> list[Tensor]:
    """The logits of actors and the values of critics, [L, ..., A] and [L, ..., 1]."""
    return [engine.outputs(observation, part=part) for part in (ACTOR, CRITIC)]


def _places(marked: Tensor) -> Tensor:
    """Where each row has a mark, int64 [L, m] of bool [L, n]; of rows with fewer marks the last one again."""
    order = marked.byte().argsort(dim=1, descending=True, stable=True)
    counts = marked.sum(1, keepdim=True)
    at = torch.arange(int(counts.max()), device=marked.device)
    return order.gather(1, at.minimum(counts - 1))


def advantages(
    columns: Mapping[str, Tensor],
    value: Tensor,
    next_value: Tensor,
    *,
    settings: RolloutSettings | LOLASettings,
    time_dim: int,
    over: tuple[int, ...],
) -> tuple[Tensor, Tensor]:
    """The advantage of each step, and the target of its value, both of the shape of `value`.

    Args:
        columns: "reward", "done" and "terminated", of lanes [L, .., T], or of members of teams [L, .., T, S].
        value: of the states before each step, [L, .., T, .., 1].
        next_value: of the states after it.
        settings: the discount, lambda, and whether advantages are normalised.
        time_dim: the axis of time.
        over: the axes over which they are normalised.
    """
    advantage, target = generalized_advantage_estimate(
        settings.gamma,
        settings.gae_lambda,
        value,
        next_value,
        *(_like(columns[name], value).expand_as(value) for name in ("reward", "done", "terminated")),
        time_dim=time_dim,
    )
    if settings.normalize_advantage:
        spread = advantage.std(over, keepdim=True)
        advantage = (advantage - advantage.mean(over, keepdim=True)) / (spread + _SMALL)
    return advantage, target


def _like(column: Tensor, value: Tensor) -> Tensor:
    """A field of lanes [L, ...] with axes of size 1 for those of values [L, ..., H] that it lacks."""
    return column.reshape(*column.shape, *[1] * (value.ndim - column.ndim))


class Rollout:
    """The turns of a rollout of all lanes in their worlds, field by field as of a `LaneTurn`.

    Args:
        steps: T, of one rollout.
        rollouts: P, those that are kept at once; by default one, without an axis of its own.
    """

    def __init__(self, lanes: Lanes, steps: int, rollouts: int | None = None) -> None:
        form, device, self._lanes = lanes.form(), lanes.who.device, lanes
        axes = (*(() if rollouts is None else (rollouts,)), len(lanes), lanes.worlds, steps)
        forms: dict[str, tuple[tuple[int, ...], torch.dtype]] = {
            "observation": (form.observation_shape, form.dtype),
            "action": (form.action_shape, torch.int64),
            "next_observation": (form.observation_shape, form.dtype),
            "reward": (form.reward_shape, torch.float32),
            "done": ((), torch.bool),
            "terminated": ((), torch.bool),
        }
        self.fields = {
            name: torch.zeros((*axes, *shape), dtype=dtype, device=device)
            for name, (shape, dtype) in forms.items()
        }
        """[L, W, T, ...], or [P, L, W, T, ...]."""
        self.steps, self.size = steps, 0

    @property
    def is_full(self) -> bool:
        return self.size == self.steps

    def refuse_full(self) -> None:
        if self.is_full:
            raise ValueError(f"the rollout already has {self.steps} steps; call update() before store()")

    def write(self, turn: LaneTurn, *rollout: int) -> None:
        """Writes the next turn, of a rollout if several are kept."""
        for name, field in self.fields.items():
            column = getattr(turn, name)
            if name in ("observation", "next_observation"):
                refuse_other_dtype(torch.as_tensor(column).dtype, field.dtype)
            of_rollout = field[rollout] if rollout else field
            of_rollout[:, :, self.size] = self._lanes.by_lane(column)
        self.size += 1

    def load(self, fields: Mapping[str, Tensor], size: int) -> None:
        for name, field in self.fields.items():
            field.copy_(fields[name])
        self.size = int(size)


def refuse_other_parts(network: nn.Module) -> None:
    parts = list(parts_of(network))
    if not isinstance(network, AgentNetworks) or parts[:2] != ["actor", "critic"]:
        raise ValueError(f'an agent has the networks {parts}; allowed: "actor" and "critic"')
