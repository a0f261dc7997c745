"""What learners do for recurrent networks: states between rollouts, sequences of turns."""

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from cprl.learners.engine.base import Engine
from cprl.learners.lanes import Lanes
from cprl.learners.teams import Teams
from cprl.networks.agent import parts_of
from cprl.networks.recurrent import state_shape_of

COMPILED_STEPS: Final = 16
"""The longest sequences whose update is compiled: torch unrolls their turns, and takes seconds for each."""

ACTOR, CRITIC = range(2)
"""Positions of the actor and the critic among an agent's networks."""

NAMES = "recurrent_state", "critic_recurrent_state"
"""The entries of the states before each step, of the actor and the critic, in the batches of losses."""


def states_in(network: nn.Module) -> dict[str, tuple[int, ...]]:
    """The shapes of the states of an agent's actor and critic by their entries; empty for networks without.

    Raises:
        ValueError: if one of them is recurrent and the other one is not.
    """
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


class Evaluated(NamedTuple):
    """What the networks give for the turns of a rollout, [L, T, ...]."""

    logits: Tensor
    value: Tensor
    next_value: Tensor
    entries: dict[str, Tensor]
    """Entries for losses: the states before each turn, and "is_init"."""


class States:
    """The states of recurrent actors and critics of L lanes, from one rollout to the next.

    Turns are evaluated in order. The actor's first state of a rollout is the one by which it acted; that of
    the critic, which does not act, is what it had after the rollout before. Gradients run through the
    `sequence` turns of a minibatch, which begin with the states that the rollout had there, as of stored
    states in Kapturowski et al., "Recurrent Experience Replay in Distributed Reinforcement Learning" (2019).

    Args:
        shapes: of the states of one lane, see `states_in`.
        lanes: the lanes.
        sequence: turns T' of a minibatch.
        device: where.
    """

    def __init__(
        self, shapes: Mapping[str, tuple[int, ...]], lanes: Lanes | Teams, *, sequence: int, device: Any
    ) -> None:
        self._lanes, self._sequence = lanes, sequence
        self._first = {name: torch.zeros(len(lanes), *shape, device=device) for name, shape in shapes.items()}
        self._ended = torch.ones(len(lanes), dtype=torch.bool, device=device)
        """Whether the episode of a lane ended with the last turn of the rollout before."""

    def forget(self) -> None:
        """The next rollout begins with new episodes."""
        self._ended.fill_(True)

    def begin(self, batch: TensorDictBase) -> None:
        """Notes by which states agents act in the first turn of a rollout."""
        self._first[NAMES[ACTOR]].copy_(self._lanes.recurrent_state(batch))

    def evaluate(self, engine: Engine, columns: Mapping[str, Tensor]) -> Evaluated:
        """Evaluates a full rollout, and keeps the critic's states for the next one.

        Args:
            engine: the networks.
            columns: the fields of the rollout, [L, T, ...].
        """
        began, states = self._began(columns["done"]), {}
        logits, states[NAMES[ACTOR]], _ = self._in_order(engine, columns, began, ACTOR)
        value, states[NAMES[CRITIC]], after = self._in_order(engine, columns, began, CRITIC)
        next_value, _ = engine.outputs(columns["next_observation"], after, part=CRITIC)
        self._first[NAMES[CRITIC]].copy_(after[:, -1])
        self._ended.copy_(columns["done"][:, -1])
        is_init = began.clone()
        is_init[:, :: self._sequence] = True
        return Evaluated(logits, value, next_value, {**states, "is_init": is_init})

    def value_next(
        self, engine: Engine, columns: Mapping[str, Tensor], size: int, seen_next: Tensor
    ) -> Tensor:
        """The value of the state after the latest turn.

        Args:
            engine: the networks.
            columns: the fields of the rollout, [L, T, ...].
            size: the turns that it has so far; 0 directly after a rollout.
            seen_next: the observations after the latest turn, [L, 1, ...].
        """
        after = self._first[NAMES[CRITIC]].unsqueeze(1)
        if size:
            so_far = {name: column[:, :size] for name, column in columns.items()}
            _, _, each = self._in_order(engine, so_far, self._began(so_far["done"]), CRITIC)
            after = each[:, -1:]
        value: Tensor = engine.outputs(seen_next, after, part=CRITIC)[0]
        return value

    def _began(self, done: Tensor) -> Tensor:
        """Whether an episode begins with a turn, bool [L, T]."""
        return torch.cat([self._ended[:, None], done[:, :-1]], 1)

    def _in_order(
        self, engine: Engine, columns: Mapping[str, Tensor], began: Tensor, part: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The outputs of a network, its states before each turn, and those after each, [L, T, ...]."""
        observation, first = columns["observation"], self._first[NAMES[part]]
        given = first.new_zeros(*observation.shape[:2], *first.shape[1:])
        given[:, 0] = torch.where(_like(began[:, 0], first), 0.0, first)
        is_init = began.clone()
        is_init[:, 0] = True
        outputs, after = engine.outputs(observation, given, is_init, part=part)
        before = torch.cat(
            [given[:, :1], torch.where(_like(began[:, 1:], after[:, 1:]), 0.0, after[:, :-1])], 1
        )
        return outputs, before, after

    def minibatches(self, numbers: Tensor) -> Tensor:
        """The turns of an epoch's minibatches, int64 [minibatches, L, T'], from random numbers [L, T]."""
        order = numbers[:, :: self._sequence].argsort(-1).T
        return order.unsqueeze(-1) * self._sequence + torch.arange(self._sequence)

    def state_dict(self) -> dict[str, Tensor]:
        """The tensors themselves, not copies."""
        return {**self._first, "ended": self._ended}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Continues from a state."""
        for name, own in self.state_dict().items():
            own.copy_(state[name])


def _like(marked: Tensor, states: Tensor) -> Tensor:
    """Flags [L, ...] with axes of size 1 for those of states [L, ..., H] that they lack."""
    return marked.reshape(*marked.shape, *[1] * (states.ndim - marked.ndim))
