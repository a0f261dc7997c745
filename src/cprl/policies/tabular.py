"""Tabular policies: tables of action values, which actors read, and the network that one is stored as."""

from collections.abc import Mapping, Sequence
from math import prod
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from cprl.values.arrays import Float64, Int64, UInt8

NEVER_MET = 0
"""The row of states that are in no table; its values stay 0."""
_FIRST_ROWS = 1024


class QTables:
    """A table of action values per lane, all in one array; a state is the bytes of an agent's observation."""

    def __init__(self, lanes: int, actions: int, *, max_states: int) -> None:
        self.max_states = max_states
        self.rows: list[dict[bytes, int]] = [{} for _ in range(lanes)]
        """For each lane, the row of each state it has met."""
        self.values = np.zeros((_FIRST_ROWS, actions), np.float64)
        """float64 [rows, A], the values of all lanes in the order in which states were met; see NEVER_MET."""
        self.visits = np.zeros((_FIRST_ROWS, actions), np.int64)
        """int64 [rows, A], how often each value was updated."""
        self.size = 1

    def find(self, states: Sequence[bytes], lanes: Sequence[int]) -> Int64:
        """The row of each state in the table of its lane, int64 [n]; `NEVER_MET` if it has none."""
        rows = [self.rows[lane].get(state, NEVER_MET) for state, lane in zip(states, lanes, strict=True)]
        return np.array(rows, np.int64)

    def find_or_add(self, states: Sequence[bytes], lanes: Sequence[int]) -> Int64:
        """As `find`, but adds a row for each state that has none."""
        rows = self.find(states, lanes)
        for n in np.flatnonzero(rows == NEVER_MET).tolist():  # of two that are the same the first adds it
            rows[n] = self.rows[lanes[n]].get(states[n]) or self._add(states[n], lanes[n])
        return rows

    def outputs(self, observation: Tensor) -> Tensor:
        """Return the action values of lanes, float64 [L, k, A], for observations [L, k, C, X, Y]; those of
        states never met are 0."""
        lanes, worlds = observation.shape[:2]
        of_states = [lane for lane in range(lanes) for _ in range(worlds)]
        seen = observation.flatten(0, 1).numpy(force=True)
        rows = self.find(states_of(seen), of_states)
        values = torch.from_numpy(self.values[rows].reshape(lanes, worlds, -1))
        return values.to(observation.device)

    def _add(self, state: bytes, lane: int) -> int:
        rows = self.rows[lane]
        if len(rows) >= self.max_states:
            raise MemoryError(
                f"lane {lane} has met {len(rows):,} states, as many as max_states allows, and meets another; "
                "use a smaller board or a smaller observation, or raise TabularSettings.max_states"
            )
        if self.size == len(self.values):
            self.values = np.concatenate([self.values, np.zeros_like(self.values)])
            self.visits = np.concatenate([self.visits, np.zeros_like(self.visits)])
        rows[state], self.size = self.size, self.size + 1
        return rows[state]

    def add_lane(self, lane: int, states: UInt8, values: Float64) -> None:
        """Adds n states, uint8 [n, bytes], with their values [n, A] to the table of a lane."""
        rows = self.find_or_add([state.tobytes() for state in states], [lane] * len(states))
        self.values[rows] = values

    def of_lane(self, lane: int) -> tuple[UInt8, Float64, Int64]:
        """Copies of the n states that a lane has met, uint8 [n, bytes], their values and visits, [n, A]."""
        states, rows = list(self.rows[lane]), list(self.rows[lane].values())
        flat = np.frombuffer(b"".join(states), np.uint8).reshape(len(states), -1 if states else 0)
        return flat.copy(), self.values[rows], self.visits[rows]

    def state_dict(self) -> dict[str, Tensor]:
        """All tables as tensors, one row per state, in the order in which the states were met."""
        known = sorted(
            (row, lane, state) for lane, rows in enumerate(self.rows) for state, row in rows.items()
        )
        states = np.frombuffer(b"".join(state for _, _, state in known), np.uint8).copy()
        return {
            "states": torch.from_numpy(states.reshape(len(known), -1) if known else states.reshape(0, 0)),
            "lanes": torch.tensor([lane for _, lane, _ in known], dtype=torch.int64),
            "values": torch.from_numpy(self.values[: self.size].copy()),
            "visits": torch.from_numpy(self.visits[: self.size].copy()),
        }

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Replaces the tables by those of a `state_dict`."""
        self.rows = [{} for _ in self.rows]
        for row, (seen, lane) in enumerate(
            zip(state["states"].numpy(), state["lanes"].tolist(), strict=True)
        ):
            self.rows[lane][seen.tobytes()] = row + 1
        self.values, self.visits = (state[name].numpy().copy() for name in ("values", "visits"))
        self.size = len(self.values)


def states_of(observations: NDArray[Any]) -> list[bytes]:
    """Return the state of each of n observations, [n, ...]: its bytes."""
    flat = np.ascontiguousarray(observations).reshape(len(observations), -1)
    return [state.tobytes() for state in flat]


class TableNetwork(nn.Module):
    """The table of one agent as a network, so that it can be saved, loaded and frozen like any other.

    Its state dict holds "states", uint8 [n, bytes], the bytes of observations, and their "values", float64
    [n, A]. It loads a state dict with any number of states n; initially n is 0.
    """

    states: Tensor
    values: Tensor

    def __init__(
        self, observation_shape: Sequence[int], actions: int, *, observation_dtype: str = "uint8"
    ) -> None:
        super().__init__()
        self.observation_dims = len(observation_shape)
        size = prod(observation_shape) * getattr(torch, observation_dtype).itemsize
        self.register_buffer("states", torch.zeros((0, size), dtype=torch.uint8))
        self.register_buffer("values", torch.zeros((0, actions), dtype=torch.float64))
        self._rows: dict[bytes, int] = {}

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *options: Any) -> None:
        for name in ("states", "values"):
            buffer, stored = getattr(self, name), state_dict.get(prefix + name)
            if stored is not None and stored.shape[1:] == buffer.shape[1:]:
                setattr(self, name, buffer.new_zeros(stored.shape))
        super()._load_from_state_dict(state_dict, prefix, *options)
        self._rows = {state.tobytes(): row for row, state in enumerate(self.states.numpy(force=True))}

    def forward(self, observation: Tensor) -> Tensor:
        """Maps observations, [..., C, X, Y], to values, float64 [..., A]; 0 for states never met."""
        leading = observation.shape[: -self.observation_dims]
        seen = observation.reshape(-1, *observation.shape[len(leading) :]).numpy(force=True)
        rows = torch.tensor([self._rows.get(state, -1) for state in states_of(seen)])
        values, known = self.values.new_zeros((len(rows), self.values.shape[1])), rows >= 0
        values[known] = self.values[rows[known]]
        return values.reshape(*leading, -1)
