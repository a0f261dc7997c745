"""Rollouts: the memory of on-policy agents, which learn from the latest turns of their present policies."""

from collections.abc import Iterator, Mapping
from typing import Any, Final

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.objectives import LossModule
from torchrl.objectives.value.functional import generalized_advantage_estimate

from cprl import recurrent_state
from cprl.keys import Turn
from cprl.learners.draw import Draw
from cprl.learners.lanes import Lanes
from cprl.learners.networks import LaneNetworks
from cprl.learners.refusals import reads, refuse_other_advantages
from cprl.learners.ring import steps_ahead
from cprl.learners.settings import LOLASettings, RolloutSettings
from cprl.learners.transitions import LaneTurn, TransitionForm, made_up, refuse_other_dtype
from cprl.networks.agent import parts_of
from cprl.networks.recurrent import state_shape_of
from cprl.policies.rng import LaneRng, Purpose

ACTOR, CRITIC = range(2)
"""Positions of the actor and the critic among an agent's networks."""

NAMES = "recurrent_state", "critic_recurrent_state"
"""The entries of the states before each step, of the actor and the critic, in the batches of losses."""

_SMALL: Final = 1e-8


def state_shapes(network: nn.Module) -> dict[str, tuple[int, ...]]:
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
        self._lanes, self._sequence, device = lanes, sequence, lanes.device
        self.shapes = shapes
        size = len(lanes), lanes.worlds
        self._first = {name: torch.zeros(*size, *shape, device=device) for name, shape in shapes.items()}
        self._ended = torch.ones(size, dtype=torch.bool, device=device)
        """Whether the episode ended with the last turn of the rollout before."""

    def forget(self) -> None:
        """The next rollout begins with new episodes."""
        self._ended.fill_(True)

    def begin(self, turn: Turn) -> None:
        """Notes by which states agents act in the first turn of a rollout."""
        first = self._first[NAMES[ACTOR]]
        first.copy_(self._lanes.by_lane(self._lanes.states(turn, recurrent_state.BEFORE, first.shape[-1])))

    def evaluate(
        self, networks: LaneNetworks, columns: Mapping[str, Tensor]
    ) -> tuple[Tensor, Tensor, Tensor, dict[str, Tensor]]:
        """The logits, values and next values of a full rollout, [L, W, T, ...], and what losses read besides:
        the states before each turn, and "is_init". Keeps the critic's states for the next rollout."""
        began, states = self._began(columns["done"]), {}
        logits, states[NAMES[ACTOR]], _ = self._in_order(networks, columns, began, ACTOR)
        value, states[NAMES[CRITIC]], after = self._in_order(networks, columns, began, CRITIC)
        next_value, _ = networks.outputs(columns["next_observation"], after, part=CRITIC)
        self._first[NAMES[CRITIC]].copy_(after[:, :, -1])
        self._ended.copy_(columns["done"][..., -1])
        is_init = began.clone()
        is_init[..., :: self._sequence] = True
        return logits, value, next_value, {**states, "is_init": is_init}

    def value_next(
        self, networks: LaneNetworks, columns: Mapping[str, Tensor], size: int, seen_next: Tensor
    ) -> Tensor:
        """The value of the state after the latest of `size` turns, 0 directly after a rollout, from the
        observations after it, [L, W, ...]."""
        after = self._first[NAMES[CRITIC]]
        if size:
            so_far = {name: column[:, :, :size] for name, column in columns.items()}
            _, _, each = self._in_order(networks, so_far, self._began(so_far["done"]), CRITIC)
            after = each[:, :, -1]
        value: Tensor = networks.outputs(seen_next, after, part=CRITIC)[0]
        return value

    def _began(self, done: Tensor) -> Tensor:
        """Whether an episode begins with a turn, bool [L, W, T]."""
        return torch.cat([self._ended.unsqueeze(-1), done[..., :-1]], -1)

    def _in_order(
        self, networks: LaneNetworks, columns: Mapping[str, Tensor], began: Tensor, part: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The outputs of a network, its states before each turn and after it, [L, W, T, ...]."""
        observation, first = columns["observation"], self._first[NAMES[part]]
        given = first.new_zeros(*observation.shape[:3], *first.shape[2:])
        given[:, :, 0] = torch.where(_like(began[..., 0], first), 0.0, first)
        is_init = began.clone()
        is_init[..., 0] = True
        outputs, after = networks.outputs(observation, given, is_init, part=part)
        begins, later = began[..., 1:], after[:, :, :-1]
        before = torch.cat([given[:, :, :1], torch.where(_like(begins, later), 0.0, later)], 2)
        return outputs, before, after

    def state_dict(self) -> dict[str, Tensor]:
        return {**self._first, "ended": self._ended}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        for name, value in self.state_dict().items():
            value.copy_(state[name])


class Rollouts:
    """Stores the turns since the last update; once T = `rollout_steps` are there, it gives minibatches of all
    T x W steps, for `epochs` epochs, with advantages by TorchRL's GAE.

    Each lane shuffles its own minibatches. Those of recurrent networks are consecutive turns of one world,
    or, where they are larger than a rollout, the rollouts of several worlds.

    Args:
        network: of one lane, an "actor" and a "critic", see `cprl.algorithms.OnPolicy`.
        loss: of one lane, which is refused if it needs other advantages.
    """

    def __init__(self, lanes: Lanes, settings: RolloutSettings, network: nn.Module, loss: LossModule) -> None:
        settings.refuse_worlds(lanes.worlds)
        refuse_other_advantages(loss, settings)
        self.lanes, self.settings = lanes, settings
        self._reads_logits = reads(loss, "logits")
        shapes = state_shapes(network)
        turns = min(settings.minibatch_size, settings.rollout_steps)
        self.sequence_steps = turns if shapes else 1
        """Consecutive turns T' of a minibatch of recurrent networks."""
        cells = shapes[NAMES[ACTOR]][-1] if shapes else 0
        self.form = lanes.form(state_cells=cells, has_in_play=settings.only_in_play)
        self.states = States(shapes, lanes, sequence=turns) if shapes else None
        self.rollout = Rollout(lanes, settings.rollout_steps, self.form)
        steps = settings.rollout_steps * lanes.worlds
        self.rng = LaneRng(lanes.seeds(Purpose.SAMPLING), steps, ahead=steps_ahead(steps))

    def write(self, turn: Turn, lane_turn: LaneTurn) -> None:
        """Stores a turn, as all agents had it, and as these lanes did."""
        self.rollout.refuse_full()
        if self.states is not None and not self.rollout.size:
            self.states.begin(turn)
        self.rollout.write(lane_turn)

    def due(self, networks: LaneNetworks) -> Iterator[Draw]:
        """The minibatches of all epochs over a full rollout; none while it is not full."""
        if not self.rollout.is_full:
            return
        batch = self._batch(networks)
        for _ in range(self.settings.epochs):
            for place in self._minibatches(self.rng.next()).to(batch["action"].device):
                yield Draw.of(batch, place)
        self.rollout.size = 0

    def example(self, lanes: int) -> TensorDict:
        """A made-up minibatch of so many lanes, in the form of those that are due."""
        settings, form = self.settings, self.form
        steps = min(settings.minibatch_size, settings.rollout_steps * self.lanes.worlds)
        size = [lanes, steps if self.states is None else self.sequence_steps]

        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.zeros(*size, *shape, dtype=dtype, device=self.lanes.device)

        members, actions = form.action_shape, self.lanes.spaces.actions
        entries = {
            "observation": zeros(*form.observation_shape, dtype=form.dtype),
            "action": zeros(*members, dtype=torch.int64),
            "action_log_prob": zeros(*members),
            **{name: zeros(*members, 1) for name in ("advantage", "value_target", "state_value")},
            **({"logits": zeros(*members, actions)} if self._reads_logits else {}),
            **({"in_play": ~zeros(*members, dtype=torch.bool)} if form.has_in_play else {}),
            **(
                {}
                if self.states is None
                else {name: zeros(*shape) for name, shape in self.states.shapes.items()}
            ),
            **({} if self.states is None else {"is_init": zeros(dtype=torch.bool)}),
        }
        return made_up(TensorDict(entries, size), actions)

    def _minibatches(self, numbers: Tensor) -> Tensor:
        """The steps of an epoch's minibatches, int64 [minibatches, L, size], from random numbers [L, W x T];
        of recurrent networks T' consecutive turns, [minibatches, L, T'], or several such sequences of each
        lane, [minibatches, L, sequences, T']."""
        size, turns = self.settings.minibatch_size, self.sequence_steps
        if self.states is None:
            return numbers.argsort(-1).view(len(numbers), -1, size).transpose(0, 1)
        sequences = numbers[:, ::turns].argsort(-1).view(len(numbers), -1, size // turns).transpose(0, 1)
        places = sequences.unsqueeze(-1) * turns + torch.arange(turns)
        return places.squeeze(2)

    @torch.no_grad()
    def _batch(self, networks: LaneNetworks) -> TensorDict:
        """The rollout with advantages, [L, W x T], under the keys of TorchRL's losses; advantages are
        normalised within each lane if the settings say so."""
        columns = self.rollout.fields
        entries: dict[str, Tensor] = {}
        if self.states is not None:
            logits, value, next_value, entries = self.states.evaluate(networks, columns)
        else:
            logits, value, next_value = self._evaluated(networks)
        over = tuple(range(1, value.ndim))
        options: dict[str, Any] = {"settings": self.settings, "over": over, "time_dim": 2}
        advantage, target = advantages(columns, value, next_value, **options)
        chosen = logits.log_softmax(-1).gather(-1, columns["action"].unsqueeze(-1)).squeeze(-1)
        read = {
            "observation": columns["observation"],
            "action": columns["action"],
            "action_log_prob": chosen,
            "advantage": advantage,
            "value_target": target,
            "state_value": value,
            **({"logits": logits} if self._reads_logits else {}),
            **({"in_play": columns["in_play"]} if self.form.has_in_play else {}),
            **entries,
        }
        size = [len(self.lanes), self.lanes.worlds * self.settings.rollout_steps]
        return TensorDict({name: entry.flatten(1, 2) for name, entry in read.items()}, size)

    def _evaluated(self, networks: LaneNetworks) -> tuple[Tensor, Tensor, Tensor]:
        """The logits, values and next values of a full rollout, [L, W, T, ...]."""
        columns = self.rollout.fields
        seen, following = (columns[name].flatten(1, 2) for name in ("observation", "next_observation"))
        done = columns["done"]
        if self.lanes.worlds == 1:  # in one piece, since products of other shapes round in other ways
            logits, value = (networks.outputs(seen, part=part) for part in (ACTOR, CRITIC))
            next_value = networks.outputs(following, part=CRITIC)
        else:  # in pieces that stay in the processor's caches
            pieces = torch.split(seen, self.settings.minibatch_size, 1)
            given = [networks.outputs_of_both(piece) for piece in pieces]
            logits, value = (torch.cat(each, 1) for each in zip(*given, strict=True))
            # What is seen after a turn is seen before the next one, but where an episode or the rollout ends.
            next_value, ends = value.roll(-1, 1), done.clone()
            ends[:, :, -1] = True
            place = _places(ends.flatten(1))
            lane = torch.arange(len(place), device=place.device)[:, None]
            next_value[lane, place] = networks.outputs(following[lane, place], part=CRITIC)
        by_turn = (entry.reshape(*done.shape, *entry.shape[2:]) for entry in (logits, value, next_value))
        logits, value, next_value = by_turn
        return logits, value, next_value

    def values(self, networks: LaneNetworks, turn: Turn) -> Tensor:
        """The value of the state after a turn, [L, W, .., 1]."""
        seen = self.lanes.seen_next(turn)
        if self.states is None:
            value: Tensor = networks.outputs(seen, part=CRITIC)
            return value
        return self.states.value_next(networks, self.rollout.fields, self.rollout.size, seen)

    def cut(self, networks: LaneNetworks) -> None:
        """Drops the rollout that a training left unfinished."""
        self.rollout.size = 0
        if self.states is not None:
            self.states.forget()

    def state_dict(self) -> dict[str, Any]:
        recurrent = {} if self.states is None else {"recurrent": self.states.state_dict()}
        return {**self.rollout.state_dict(), "order": self.rng.state_dict(), **recurrent}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.rollout.load_state_dict(state)
        self.rng.load_state_dict(state["order"])
        if self.states is not None:
            self.states.load_state_dict(state["recurrent"])


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
        columns: "reward", "done" and "terminated", of lanes [L, .., T], or of members of teams [L, .., T, S];
            and "in_play", likewise, if advantages are normalised by those of turns in play.
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
        mean, spread = _mean_and_spread(advantage, columns.get("in_play"), over)
        advantage = (advantage - mean) / (spread + _SMALL)
    return advantage, target


def _mean_and_spread(values: Tensor, counted: Tensor | None, over: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """The mean and standard deviation over some axes, which stay with size 1; of marked values alone."""
    if counted is None:
        return values.mean(over, keepdim=True), values.std(over, keepdim=True)
    counts = _like(counted, values).expand_as(values)
    number = counts.sum(over, keepdim=True)
    mean = torch.where(counts, values, 0.0).sum(over, keepdim=True) / number.clamp(min=1)
    squares = torch.where(counts, (values - mean).square(), 0.0).sum(over, keepdim=True)
    return mean, (squares / (number - 1).clamp(min=1)).sqrt()


def _like(column: Tensor, value: Tensor) -> Tensor:
    """A field of lanes [L, ...] with axes of size 1 for those of values [L, ..., H] that it lacks."""
    return column.reshape(*column.shape, *[1] * (value.ndim - column.ndim))


class Rollout:
    """The turns of a rollout of all lanes in their worlds, field by field as of a `LaneTurn`.

    Args:
        steps: T, of one rollout.
        form: what is stored of a turn.
        rollouts: P, those that are kept at once; by default one, without an axis of its own.
    """

    def __init__(self, lanes: Lanes, steps: int, form: TransitionForm, rollouts: int | None = None) -> None:
        device, self._lanes = lanes.device, lanes
        axes = (*(() if rollouts is None else (rollouts,)), len(lanes), lanes.worlds, steps)
        forms: dict[str, tuple[tuple[int, ...], torch.dtype]] = {
            "observation": (form.observation_shape, form.dtype),
            "action": (form.action_shape, torch.int64),
            "next_observation": (form.observation_shape, form.dtype),
            "reward": (form.reward_shape, torch.float32),
            "done": ((), torch.bool),
            "terminated": ((), torch.bool),
            **({"in_play": (form.action_shape, torch.bool)} if form.has_in_play else {}),
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

    def state_dict(self) -> dict[str, Any]:
        return {"fields": self.fields, "size": self.size}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        for name, field in self.fields.items():
            field.copy_(state["fields"][name])
        self.size = int(state["size"])
