"""Tables of action values: `QTables`, by which tabular agents act and learn, and `TableNetwork`, the network
as which the table of one agent is stored."""

from collections.abc import Mapping, Sequence
from math import prod
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from cprl.values.array_types import Float64, Int64, UInt8

NEVER_MET = 0
"""The row of all states that are in no table; its values stay 0."""
_FIRST_ROWS = 1024
"""The rows that are allocated first; they double when they are full."""


class QTables:
    """A table of action values for each lane, all in one array; a state is the bytes of an observation.

    Args:
        lanes: the number of lanes L.
        actions: the number of actions A.
        max_states: the largest number of states in a lane's table.
    """

    def __init__(self, lanes: int, actions: int, *, max_states: int) -> None:
        self.max_states = max_states
        self.rows: list[dict[bytes, int]] = [{} for _ in range(lanes)]
        """For each lane, the row of each state it has met."""
        self.values = np.zeros((_FIRST_ROWS, actions), np.float64)
        """float64 [rows, A], the values of all lanes, in the order in which states were met; row `NEVER_MET`
        is no state's."""
        self.visits = np.zeros((_FIRST_ROWS, actions), np.int64)
        """int64 [rows, A], the number of updates of each value."""
        self.size = 1
        """The number of rows in use."""

    def find(self, states: Sequence[bytes], lanes: Sequence[int]) -> Int64:
        """Return the row of each state in the table of its lane, int64 [n]; `NEVER_MET` if it has none."""
        rows = [self.rows[lane].get(state, NEVER_MET) for state, lane in zip(states, lanes, strict=True)]
        return np.array(rows, np.int64)

    def find_or_add(self, states: Sequence[bytes], lanes: Sequence[int]) -> Int64:
        """Return the row of each state in the table of its lane, int64 [n]; add a row for a state without
        one."""
        rows = self.find(states, lanes)
        for n in np.flatnonzero(rows == NEVER_MET).tolist():
            # A new state may be there twice: then the first adds the row, and the second finds it.
            rows[n] = self.rows[lanes[n]].get(states[n]) or self._add(states[n], lanes[n])
        return rows

    def outputs(self, observation: Tensor) -> Tensor:
        """Return the action values of lanes, float64 [L, k, A], for observations [L, k, C, X, Y]; 0 for
        states that were never met."""
        lanes, worlds = observation.shape[:2]
        lane_by_state = [lane for lane in range(lanes) for _ in range(worlds)]
        flat = observation.flatten(0, 1).numpy(force=True)
        rows = self.find(states_of(flat), lane_by_state)
        values = torch.from_numpy(self.values[rows].reshape(lanes, worlds, -1))
        return values.to(observation.device)

    def _add(self, state: bytes, lane: int) -> int:
        """Add a state to the table of a lane; return its row."""
        rows = self.rows[lane]
        if len(rows) >= self.max_states:
            raise MemoryError(
                f"lane {lane} has met {len(rows):,} states, as many as max_states allows, and meets another; "
                "use a smaller board or a smaller observation, or raise TabularSettings.max_states"
            )
        if self.size == len(self.values):
            self.values = np.concatenate([self.values, np.zeros_like(self.values)])
            self.visits = np.concatenate([self.visits, np.zeros_like(self.visits)])
        rows[state] = self.size
        self.size += 1
        return rows[state]

    def add_lane(self, lane: int, states: UInt8, values: Float64) -> None:
        """Add n states, uint8 [n, bytes], to the table of a lane, with their values, [n, A]."""
        rows = self.find_or_add([state.tobytes() for state in states], [lane] * len(states))
        self.values[rows] = values

    def lane_table(self, lane: int) -> tuple[UInt8, Float64, Int64]:
        """Return copies of the n states that a lane has met, uint8 [n, bytes], of their values and of their
        visits, [n, A] each."""
        states = list(self.rows[lane])
        rows = list(self.rows[lane].values())
        return _as_array(states), self.values[rows], self.visits[rows]

    def state_dict(self) -> dict[str, Tensor]:
        """Return all tables as tensors, one row per state, in the order in which the states were met."""
        by_row = sorted(
            (row, lane, state) for lane, rows in enumerate(self.rows) for state, row in rows.items()
        )
        states = _as_array([state for _, _, state in by_row])
        return {
            "states": torch.from_numpy(states),
            "lanes": torch.tensor([lane for _, lane, _ in by_row], dtype=torch.int64),
            "values": torch.from_numpy(self.values[: self.size].copy()),
            "visits": torch.from_numpy(self.visits[: self.size].copy()),
        }

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Replace the tables by those of a `state_dict`."""
        self.rows = [{} for _ in self.rows]
        states_and_lanes = zip(state["states"].numpy(), state["lanes"].tolist(), strict=True)
        for row, (table_state, lane) in enumerate(states_and_lanes, start=1):  # row 0 is NEVER_MET
            self.rows[lane][table_state.tobytes()] = row
        self.values = state["values"].numpy().copy()
        self.visits = state["visits"].numpy().copy()
        self.size = len(self.values)


def _as_array(states: Sequence[bytes]) -> UInt8:
    """Return n states as an array, uint8 [n, bytes]; [0, 0] for no state."""
    flat = np.frombuffer(b"".join(states), np.uint8).copy()
    size = len(states[0]) if states else 0
    return flat.reshape(len(states), size)


def states_of(observations: NDArray[Any]) -> list[bytes]:
    """Return the states of n observations, [n, ...]: the bytes of each."""
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
            buffer = getattr(self, name)
            stored = state_dict.get(prefix + name)
            if stored is not None and len(stored) == 0:  # a table without states knows no size of one
                stored = buffer[:0]
                state_dict[prefix + name] = stored
            if stored is not None and stored.shape[1:] == buffer.shape[1:]:
                setattr(self, name, buffer.new_zeros(stored.shape))
        super()._load_from_state_dict(state_dict, prefix, *options)
        self._rows = {state.tobytes(): row for row, state in enumerate(self.states.numpy(force=True))}

    def forward(self, observation: Tensor) -> Tensor:
        """Map observations, [..., C, X, Y], to action values, float64 [..., A]; 0 for states that were never
        met."""
        batch_shape = observation.shape[: -self.observation_dims]
        flat = observation.reshape(-1, *observation.shape[len(batch_shape) :]).numpy(force=True)
        rows = torch.tensor([self._rows.get(state, -1) for state in states_of(flat)])
        was_met = rows >= 0
        values = self.values.new_zeros((len(rows), self.values.shape[1]))
        values[was_met] = self.values[rows[was_met]]
        return values.reshape(*batch_shape, -1)
