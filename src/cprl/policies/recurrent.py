"""Actors of lanes with recurrent networks, whose states the TensorDict carries from turn to turn."""

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, exploration_type

from cprl import arguments
from cprl.commons.spaces import Spaces
from cprl.policies.lanes import LaneActor
from cprl.system.compiling import Compiled


class RecurrentLaneActor(LaneActor):
    """Chooses actions by recurrent networks; other arguments are those of `LaneActor`.

    Args:
        values: maps observations [L, k, ...] and states [L, k, H] to logits or action values [L, k, A] and
            the states afterwards.
        actions: the number of actions A.
        state_cells: the numbers H of a state.

    Reads "observation" and "recurrent_state", float32 [R x k, S, H]; writes "action" and "recurrent_state".
    """

    in_keys = ("observation", "recurrent_state")
    out_keys = ("action", "recurrent_state")

    def __init__(self, values: Callable[..., Any], actions: int, *, state_cells: int, **how: Any) -> None:
        super().__init__(values, actions, **how)
        self.state_cells = arguments.integer("state_cells", state_cells, 1)
        is_compiled = bool(how.get("compile", False))
        self._explore = Compiled(type(self)._explored_with, what="agents act", enabled=is_compiled)

    def _alike(self, values: Callable[..., Any], **lanes: Any) -> LaneActor:
        """See `LaneActor`."""
        how: dict[str, Any] = {"state_cells": self.state_cells, "stochastic": self.stochastic}
        return RecurrentLaneActor(values, self.actions, **how, **lanes)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes "action", int64 [R x k, S], and "recurrent_state", from the turn's entries."""
        chosen, after = self.choose_with(tensordict.get("observation"), tensordict.get("recurrent_state"))
        return tensordict.set("action", chosen).set("recurrent_state", after)

    def choose(self, observation: Tensor) -> Tensor:
        """Raises a ValueError: an action depends on the state; see `choose_with`."""
        raise ValueError("a recurrent actor needs a state; allowed: choose_with(observation, state)")

    def choose_with(self, observation: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Actions, int64 [R x k, S], and states afterwards, float32 [R x k, S, H].

        Args:
            observation: [R x k, S, ...].
            state: before this turn, [R x k, S, H].
        """
        if exploration_type() not in (ExplorationType.RANDOM, None):
            values, after = self._step(observation, state)
            return self._by_replica(values.argmax(-1)), after
        device = observation.device
        given = observation, state, self.rng.next().to(device), self._epsilon.to(device)
        form = observation.shape, observation.dtype, state.shape
        chosen, after = self._explore(form, self, *given)
        return chosen, after

    def preferences(self, observation: Tensor, state: Tensor | None = None) -> Tensor | None:
        """See `LaneActor`; with the states before the turn, [R x k, S, H]."""
        if state is None:
            raise ValueError("state is None; allowed for recurrent networks: their states before the turn")
        values = self._by_replica(self._step(observation, state)[0])
        return values.softmax(-1) if self.stochastic else values

    def _explored_with(
        self, observation: Tensor, state: Tensor, numbers: Tensor, epsilon: Tensor
    ) -> list[Tensor]:
        """Exploring actions, and the states afterwards."""
        values, after = self._step(observation, state)
        return [self._by_replica(self._chosen(values, numbers, epsilon)), after]

    def _step(self, observation: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Outputs of each lane's network [L, k, A], and the states afterwards [R x k, S, H]."""
        assert self.values is not None
        with torch.no_grad():
            values, after = self.values(self._by_lane(observation), self._by_lane(state))
        return values, self._by_replica(after)


def actor_of_lanes(
    values: Callable[..., Any] | None, spaces: Spaces, *, state_cells: int = 0, **how: Any
) -> LaneActor:
    """The actor for networks with states of so many numbers, or without: a `RecurrentLaneActor` or a
    `LaneActor`."""
    if not state_cells or values is None:
        return LaneActor(values, spaces.actions, **how)
    return RecurrentLaneActor(values, spaces.actions, state_cells=state_cells, **how)
