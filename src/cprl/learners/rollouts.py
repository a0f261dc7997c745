"""Rollouts: the memory of on-policy agents, which learn from the turns of their current policies alone."""

from collections.abc import Iterator, Mapping
from typing import Any, Final

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.objectives import LossModule
from torchrl.objectives.value.functional import generalized_advantage_estimate

from cprl.keys import Turn, recurrent_state
from cprl.learners.draw import Draw
from cprl.learners.lanes import Lanes
from cprl.learners.networks import LaneNetworks
from cprl.learners.refusals import reads, refuse_other_advantages
from cprl.learners.ring import steps_per_block
from cprl.learners.settings import LOLASettings, RolloutSettings
from cprl.learners.transitions import LaneTurn, TransitionForm, randomized, refuse_other_dtype
from cprl.networks.agent import networks_by_name
from cprl.networks.recurrent import state_shape_of
from cprl.policies.rng import LaneRng, Purpose

ACTOR, CRITIC = range(2)
"""The indices of the actor and the critic among an agent's networks."""

STATE_NAMES: Final = ("recurrent_state", "critic_recurrent_state")
"""The entries of batches with the recurrent states before each step, of the actor and of the critic."""

_SMALL: Final = 1e-8
"""Added to the standard deviation by which advantages are divided."""


def state_shapes(network: nn.Module) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the recurrent states of actor and critic, by their entries in `STATE_NAMES`; empty
    if neither is recurrent.

    Raises:
        ValueError: if only one of them is recurrent.
    """
    shapes: dict[str, Any] = {}
    for name in ("actor", "critic"):
        shapes[name] = state_shape_of(networks_by_name(network)[name])
    stateless = [name for name, shape in shapes.items() if shape is None]
    if len(stateless) == 1:
        raise ValueError(
            f'the "{stateless[0]}" is not recurrent; allowed beside a network that is: a GRU or an LSTM'
        )
    return {} if stateless else dict(zip(STATE_NAMES, shapes.values(), strict=True))


class States:
    """The recurrent states of the actors and critics of L lanes in W worlds, from one rollout to the next.

    A rollout begins with the actor's state when it acted in the first turn, and with the critic's state after
    the rollout before, since critics do not act. Each sequence of a minibatch begins with the states that the
    rollout has in its first turn: the stored states of Kapturowski et al., "Recurrent Experience Replay in
    Distributed Reinforcement Learning" (2019). Gradients run through one sequence.

    Args:
        shapes: see `state_shapes`.
        sequence_steps: the consecutive turns T' of a sequence.
    """

    def __init__(self, shapes: Mapping[str, tuple[int, ...]], lanes: Lanes, *, sequence_steps: int) -> None:
        self._lanes = lanes
        self._sequence_steps = sequence_steps
        device = lanes.device
        self.shapes = shapes
        size = len(lanes), lanes.worlds
        self._first = {name: torch.zeros(*size, *shape, device=device) for name, shape in shapes.items()}
        """The states before the first turn of the rollout, [L, W, *shape], by `STATE_NAMES`."""
        self._ended = torch.ones(size, dtype=torch.bool, device=device)
        """Marks the worlds whose episode ended with the last turn of the rollout before, [L, W]."""

    def forget(self) -> None:
        """Begin the next rollout with new episodes."""
        self._ended.fill_(True)

    def begin(self, turn: Turn) -> None:
        """Store the states with which agents act in the first turn of a rollout."""
        first = self._first[STATE_NAMES[ACTOR]]
        first.copy_(self._lanes.by_lane(self._lanes.states(turn, recurrent_state.BEFORE, first.shape[-1])))

    def evaluate(
        self, networks: LaneNetworks, columns: Mapping[str, Tensor]
    ) -> tuple[Tensor, Tensor, Tensor, dict[str, Tensor]]:
        """Evaluate actor and critic on a full rollout; keep the critic's last states for the next rollout.

        Returns:
            Logits, values and next values, [L, W, T, ...], and the entries that losses of recurrent networks
            read besides: the states before each turn, and "is_init".
        """
        actor, critic = STATE_NAMES
        begins = self._mark_begins(columns["done"])
        logits, actor_states, _ = self._run_network(networks, columns, begins, ACTOR)
        value, critic_states, states_after = self._run_network(networks, columns, begins, CRITIC)
        next_value, _ = networks.outputs(columns["next_observation"], states_after, part=CRITIC)
        self._first[critic].copy_(states_after[:, :, -1])
        self._ended.copy_(columns["done"][..., -1])
        is_init = begins.clone()
        is_init[..., :: self._sequence_steps] = True
        return logits, value, next_value, {actor: actor_states, critic: critic_states, "is_init": is_init}

    def next_value(
        self, networks: LaneNetworks, columns: Mapping[str, Tensor], turns: int, next_observation: Tensor
    ) -> Tensor:
        """Return the value of the state after the latest turn, [L, W, 1].

        Args:
            columns: the fields of the rollout, [L, W, T, ...].
            turns: the turns of the rollout so far; 0 directly after the rollout before.
            next_observation: what lanes observe after the latest turn, [L, W, ...].
        """
        states = self._first[STATE_NAMES[CRITIC]]
        if turns:
            played = {name: column[:, :, :turns] for name, column in columns.items()}
            _, _, states_after = self._run_network(
                networks, played, self._mark_begins(played["done"]), CRITIC
            )
            states = states_after[:, :, -1]
        return networks.outputs(next_observation, states, part=CRITIC)[0]

    def _mark_begins(self, done: Tensor) -> Tensor:
        """Return which turns begin an episode, bool [L, W, T]."""
        return torch.cat([self._ended.unsqueeze(-1), done[..., :-1]], -1)

    def _run_network(
        self, networks: LaneNetworks, columns: Mapping[str, Tensor], begins: Tensor, part: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Run a recurrent network over a rollout, turn by turn.

        Returns:
            Its outputs, its states before each turn, and its states after each turn, [L, W, T, ...].
        """
        observation = columns["observation"]
        first = self._first[STATE_NAMES[part]]
        states = first.new_zeros(*observation.shape[:3], *first.shape[2:])
        states[:, :, 0] = torch.where(_add_axes(begins[..., 0], first), 0.0, first)
        is_init = begins.clone()
        is_init[..., 0] = True
        outputs, states_after = networks.outputs(observation, states, is_init, part=part)
        earlier = states_after[:, :, :-1]
        carried = torch.where(_add_axes(begins[..., 1:], earlier), 0.0, earlier)
        return outputs, torch.cat([states[:, :, :1], carried], 2), states_after

    def state_dict(self) -> dict[str, Tensor]:
        return {**self._first, "ended": self._ended}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        for name, value in self.state_dict().items():
            value.copy_(state[name])


class Rollouts:
    """A memory of the turns since the last update.

    When it has T = `rollout_steps` turns, it computes advantages by TorchRL's GAE and yields minibatches of
    all T x W steps, for `epochs` epochs. Each lane shuffles its own steps. A minibatch of recurrent networks
    is a sequence of consecutive turns of one world, or, if it is larger than a rollout, the rollouts of
    several worlds.

    Args:
        lanes: the agents that learn.
        settings: say when an update is due, and how advantages and minibatches are made.
        network: the networks of one lane, an "actor" and a "critic", see `cprl.algorithms.OnPolicy`.
        loss: the loss of one lane; refused if it needs other advantages.
    """

    def __init__(self, lanes: Lanes, settings: RolloutSettings, network: nn.Module, loss: LossModule) -> None:
        settings.refuse_worlds(lanes.worlds)
        refuse_other_advantages(loss, settings)
        self.lanes = lanes
        self.settings = settings
        self._reads_logits = reads(loss, "logits")
        shapes = state_shapes(network)
        turns = min(settings.minibatch_size, settings.rollout_steps)
        self.form = lanes.form(
            state_cells=shapes[STATE_NAMES[ACTOR]][-1] if shapes else 0,
            sequence_steps=turns if shapes else 1,
            has_in_play=settings.only_in_play,
        )
        self.states = States(shapes, lanes, sequence_steps=turns) if shapes else None
        self.rollout = Rollout(lanes, settings.rollout_steps, self.form)
        steps = settings.rollout_steps * lanes.worlds
        self.rng = LaneRng(lanes.seeds(Purpose.SAMPLING), steps, ahead=steps_per_block(steps))

    def write(self, turn: Turn, lane_turn: LaneTurn) -> None:
        """Store a turn; `Memory.write` says the arguments."""
        if self.states is not None and not self.rollout.size:
            self.states.begin(turn)
        self.rollout.write(lane_turn)

    def due(self, networks: LaneNetworks) -> Iterator[Draw]:
        """Yield the minibatches of all epochs if the rollout is full; then begin the next one."""
        if not self.rollout.is_full:
            return
        batch = self._batch(networks)
        for _ in range(self.settings.epochs):
            for index in self._minibatches(self.rng.next()).to(batch["action"].device):
                yield Draw.of(batch, index)
        self.rollout.size = 0

    def example(self, lanes: int) -> TensorDict:
        """Return a synthetic minibatch of a number of lanes, in the shapes of those that `due` yields."""
        settings = self.settings
        steps = min(settings.minibatch_size, settings.rollout_steps * self.lanes.worlds)
        size = lanes, 1, steps if self.states is None else self.form.sequence_steps
        device = self.lanes.device
        actions = self.lanes.spaces.actions
        columns = {
            name: torch.zeros(*size, *shape, dtype=dtype, device=device)
            for name, (shape, dtype) in self.form.fields.items()
        }
        logits = torch.zeros(*size, *self.form.action_shape, actions, device=device)
        value = logits[..., :1]
        states: dict[str, Tensor] = {}
        if self.states is not None:
            for name, shape in self.states.shapes.items():
                states[name] = torch.zeros(*size, *shape, device=device)
            states["is_init"] = torch.zeros(size, dtype=torch.bool, device=device)
        return randomized(self._entries(columns, logits, value, value, states), actions)

    def _minibatches(self, numbers: Tensor) -> Tensor:
        """Return the steps of each minibatch of an epoch.

        Args:
            numbers: random numbers of the steps of each lane, [L, W x T], whose order is that of the epoch.

        Returns:
            int64 [minibatches, L, minibatch_size]; with recurrent networks [minibatches, L, T'], or
            [minibatches, L, sequences, T'] if a minibatch has several sequences of each lane.
        """
        size = self.settings.minibatch_size
        turns = self.form.sequence_steps
        if self.states is None:
            return numbers.argsort(-1).view(len(numbers), -1, size).transpose(0, 1)
        sequences = numbers[:, ::turns].argsort(-1).view(len(numbers), -1, size // turns).transpose(0, 1)
        steps = sequences.unsqueeze(-1) * turns + torch.arange(turns)
        return steps.squeeze(2)

    @torch.no_grad()
    def _batch(self, networks: LaneNetworks) -> TensorDict:
        """Return the rollout with advantages, [L, W x T], under the keys of TorchRL's losses."""
        columns = self.rollout.fields
        if self.states is not None:
            return self._entries(columns, *self.states.evaluate(networks, columns))
        return self._entries(columns, *self._evaluate(networks), {})

    def _entries(
        self,
        columns: Mapping[str, Tensor],
        logits: Tensor,
        value: Tensor,
        next_value: Tensor,
        states: Mapping[str, Tensor],
    ) -> TensorDict:
        """Return rollouts with what actor and critic say of them, [L, W, T, ...], as one batch of steps, [L,
        W x T].

        If the settings say so, advantages are normalised within each lane.

        Args:
            columns: the fields of the rollouts.
            logits: the outputs of the actor.
            value: the values of the states before each step.
            next_value: the values of the states after each step.
            states: the entries that losses of recurrent networks read besides.
        """
        all_but_lanes = tuple(range(1, value.ndim))
        advantage, target = advantages(
            columns, value, next_value, settings=self.settings, over=all_but_lanes, time_dim=2
        )
        log_probs = logits.log_softmax(-1).gather(-1, columns["action"].unsqueeze(-1)).squeeze(-1)
        entries = {
            **states,
            "observation": columns["observation"],
            "action": columns["action"],
            "action_log_prob": log_probs,
            "advantage": advantage,
            "value_target": target,
            "state_value": value,
        }
        if self._reads_logits:
            entries["logits"] = logits
        if self.form.has_in_play:
            entries["in_play"] = columns["in_play"]
        lanes, worlds, steps = columns["done"].shape
        return TensorDict(
            {name: entry.flatten(1, 2) for name, entry in entries.items()}, [lanes, worlds * steps]
        )

    def _evaluate(self, networks: LaneNetworks) -> tuple[Tensor, Tensor, Tensor]:
        """Return the logits, values and next values of a full rollout, [L, W, T, ...]."""
        columns = self.rollout.fields
        observation = columns["observation"].flatten(1, 2)
        next_observation = columns["next_observation"].flatten(1, 2)
        done = columns["done"]
        if self.lanes.worlds == 1:
            # In one piece: a matrix product of another shape rounds differently.
            logits = networks.outputs(observation, part=ACTOR)
            value = networks.outputs(observation, part=CRITIC)
            next_value = networks.outputs(next_observation, part=CRITIC)
        else:
            # In pieces that fit into the processor's caches.
            pieces = torch.split(observation, self.settings.minibatch_size, 1)
            outputs = [networks.outputs_of_both(piece) for piece in pieces]
            logits, value = (torch.cat(piece_outputs, 1) for piece_outputs in zip(*outputs, strict=True))
            next_value = self._shift_values(networks, value, next_observation, done)
        logits, value, next_value = (
            entry.reshape(*done.shape, *entry.shape[2:]) for entry in (logits, value, next_value)
        )
        return logits, value, next_value

    def _shift_values(
        self, networks: LaneNetworks, value: Tensor, next_observation: Tensor, done: Tensor
    ) -> Tensor:
        """Return the values of the states after each step, [L, W x T, ...], from those before each step.

        The state after a step is the state before the next one, so its value is known; except where an
        episode or the rollout ends, where the critic computes it.
        """
        next_value = value.roll(-1, 1)
        ends = done.clone()
        ends[:, :, -1] = True
        step = _marked_indices(ends.flatten(1))
        lane = torch.arange(len(step), device=step.device)[:, None]
        next_value[lane, step] = networks.outputs(next_observation[lane, step], part=CRITIC)
        return next_value

    def values(self, networks: LaneNetworks, turn: Turn) -> Tensor:
        """Return the value of the state after a turn, [L, W, .., 1]."""
        next_observation = self.lanes.next_observations(turn)
        if self.states is None:
            return networks.outputs(next_observation, part=CRITIC)
        return self.states.next_value(networks, self.rollout.fields, self.rollout.size, next_observation)

    def cut(self, networks: LaneNetworks) -> None:
        """Drop the rollout that a training left unfinished."""
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


def _marked_indices(marked: Tensor) -> Tensor:
    """Return the indices of the marks in each row of a bool tensor [L, n], int64 [L, m].

    m is the number of marks in the row with most; rows with fewer repeat their last index.
    """
    order = marked.byte().argsort(dim=1, descending=True, stable=True)
    counts = marked.sum(1, keepdim=True)
    ordinal = torch.arange(int(counts.max()), device=marked.device)
    return order.gather(1, ordinal.minimum(counts - 1))


def advantages(
    columns: Mapping[str, Tensor],
    value: Tensor,
    next_value: Tensor,
    *,
    settings: RolloutSettings | LOLASettings,
    time_dim: int,
    over: tuple[int, ...],
) -> tuple[Tensor, Tensor]:
    """Return the advantage of each step and the target of its value, both in the shape of `value`.

    Args:
        columns: "reward", "done" and "terminated", [L, .., T], or [L, .., T, S] for members of teams; also
            "in_play", of the same shape, if only advantages of turns in play count for the normalisation.
        value: the values of the states before each step, [L, .., T, .., 1].
        next_value: the values of the states after each step, in the same shape.
        settings: the discount, lambda, and whether advantages are normalised.
        time_dim: the axis of time.
        over: the axes over which advantages are normalised.
    """
    advantage, target = generalized_advantage_estimate(
        settings.gamma,
        settings.gae_lambda,
        value,
        next_value,
        *(_add_axes(columns[name], value).expand_as(value) for name in ("reward", "done", "terminated")),
        time_dim=time_dim,
    )
    if settings.normalize_advantage:
        mean, deviation = _mean_and_deviation(advantage, columns.get("in_play"), over)
        advantage = (advantage - mean) / (deviation + _SMALL)
    return advantage, target


def _mean_and_deviation(
    values: Tensor, counted: Tensor | None, over: tuple[int, ...]
) -> tuple[Tensor, Tensor]:
    """Return the mean and the standard deviation of values over some axes, which stay with size 1.

    Args:
        counted: marks the values that count, bool; None if all do.
        over: the axes.
    """
    if counted is None:
        return values.mean(over, keepdim=True), values.std(over, keepdim=True)
    is_counted = _add_axes(counted, values).expand_as(values)
    count = is_counted.sum(over, keepdim=True)
    mean = torch.where(is_counted, values, 0.0).sum(over, keepdim=True) / count.clamp(min=1)
    squares = torch.where(is_counted, (values - mean).square(), 0.0).sum(over, keepdim=True)
    return mean, (squares / (count - 1).clamp(min=1)).sqrt()


def _add_axes(column: Tensor, value: Tensor) -> Tensor:
    """Append axes of size 1 to a tensor [L, ...] until it has as many axes as another, [L, ..., H]."""
    return column.reshape(*column.shape, *[1] * (value.ndim - column.ndim))


class Rollout:
    """The stored turns of one rollout, or several, of all lanes in their worlds, by the fields of `LaneTurn`.

    Args:
        steps: the turns T of a rollout.
        form: the shapes of what is stored of a turn.
        rollouts: the number P of rollouts that are kept at once, along a first axis; None for one without
            this axis.
    """

    def __init__(self, lanes: Lanes, steps: int, form: TransitionForm, rollouts: int | None = None) -> None:
        self._lanes = lanes
        rollout_axis = () if rollouts is None else (rollouts,)
        axes = (*rollout_axis, len(lanes), lanes.worlds, steps)
        self.fields = {
            name: torch.zeros((*axes, *shape), dtype=dtype, device=lanes.device)
            for name, (shape, dtype) in form.fields.items()
        }
        """The stored turns, [L, W, T, ...], or [P, L, W, T, ...]."""
        self.steps = steps
        self.size = 0
        """The turns of the current rollout that are stored."""

    @property
    def is_full(self) -> bool:
        """Return whether all turns of the rollout are stored."""
        return self.size == self.steps

    def write(self, turn: LaneTurn, rollout: int | None = None) -> None:
        """Write the next turn.

        Args:
            rollout: the index of the rollout if several are kept; None for one.

        Raises:
            ValueError: if the rollout is full.
        """
        if self.is_full:
            raise ValueError(f"the rollout already has {self.steps} steps; call update() before store()")
        for name, field in self.fields.items():
            column = getattr(turn, name)
            if name in ("observation", "next_observation"):
                refuse_other_dtype(torch.as_tensor(column).dtype, field.dtype)
            rollout_field = field if rollout is None else field[rollout]
            rollout_field[:, :, self.size] = self._lanes.by_lane(column)
        self.size += 1

    def state_dict(self) -> dict[str, Any]:
        return {"fields": self.fields, "size": self.size}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        for name, field in self.fields.items():
            field.copy_(state["fields"][name])
        self.size = int(state["size"])
