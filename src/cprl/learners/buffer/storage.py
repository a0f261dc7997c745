"""LaneStorage: a ring buffer for the transitions of many lanes that stores each observation once.

A lane is one agent of one replica. All lanes step together, so a transition is a row [L]; each lane samples
for itself. The observation after a transition is also the one before the next transition, and is stored once.
Only at the end of an episode it takes an extra row.
"""

from collections.abc import Mapping, Sequence
from math import prod
from typing import Any, Final

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data.replay_buffers import Storage

from cprl.learners.buffer.gather import STATE, Fields, Horizon, gather, sequences
from cprl.learners.transitions import LaneTurn, array_of, turn_of

ENDS_PER_TRANSITION: Final = 0.02
"""Extra rows for the last observations of episodes: one per fifty transitions. With episodes shorter than 50
steps the buffer holds fewer transitions; those that it holds are always correct."""

LOOKS_EVERY: Final = 32
"""Steps between checks for transitions whose observations are about to be overwritten."""


def torch_dtype(name: str) -> torch.dtype:
    """The torch dtype of a name that numpy and torch share, e.g. "uint8".

    Raises:
        ValueError: if torch has no dtype of that name.
    """
    dtype = getattr(torch, name, None)
    if not isinstance(dtype, torch.dtype):
        raise ValueError(f"dtype is {name!r}; allowed: the name of a torch dtype, e.g. 'uint8' or 'float32'")
    return dtype


def storage_bytes(
    lanes: int,
    transitions: int,
    observation_shape: Sequence[int],
    *,
    action_shape: Sequence[int] = (),
    reward_shape: Sequence[int] = (),
    item_bytes: int = 1,
    state_cells: int = 0,
) -> int:
    """Bytes that `LaneStorage` allocates.

    Args:
        lanes: the number of lanes L.
        transitions: the capacity per lane, T.
        observation_shape: (C, X, Y).
        action_shape: the shape of a lane's action.
        reward_shape: the shape of its reward.
        item_bytes: bytes of one number of an observation.
        state_cells: the numbers of a recurrent state.
    """
    windows = _rows(transitions) * (prod(observation_shape) * item_bytes + 4 * state_cells)
    return lanes * (windows + transitions * (8 * prod(action_shape) + 4 * prod(reward_shape) + 8 + 1 + 1))


def _rows(transitions: int) -> int:
    """Observation rows per lane: one per transition, those for the ends of episodes, and at most two per step
    until the next check for overwritten rows."""
    return transitions + max(8, round(transitions * ENDS_PER_TRANSITION)) + 2 * LOOKS_EVERY + 2


class LaneStorage(Storage):
    """Stores up to T transitions of each of L lanes; those of recurrent agents with their states.

    Args:
        lanes: the number of lanes L.
        transitions: the capacity per lane, T.
        observation_shape: (C, X, Y); (S, C, X, Y) if a lane is a team of S agents.
        action_shape: the shape of a lane's action: () for one agent, (S,) for a team.
        reward_shape: the shape of a lane's reward: (S,) for a team whose members have their own, else ().
        dtype: the dtype of observations.
        horizon: steps and discount of the returns that `get` returns as rewards; None for single steps.
        state_cells: the numbers K of the state of a lane's recurrent network; 0 for one without.
        sequence_steps: turns of the sequences that `get` returns; 1 for transitions.
        device: the device of the tensors.

    Inputs and outputs are TensorDicts with TorchRL's default keys: "observation", "action" and "next" with
    "observation", "reward", "done" and "terminated", with a state also "recurrent_state" and that of "next";
    [L] or [1, L] for a step, [L, b] for a sample, or as `sequences` says.
    """

    def __init__(
        self,
        *,
        lanes: int,
        transitions: int,
        observation_shape: Sequence[int],
        action_shape: Sequence[int] = (),
        reward_shape: Sequence[int] = (),
        dtype: torch.dtype = torch.uint8,
        horizon: Horizon | None = None,
        state_cells: int = 0,
        sequence_steps: int = 1,
        device: str | torch.device = "cpu",
    ) -> None:
        super().__init__(transitions)
        self.horizon, self.sequence_steps = horizon, sequence_steps
        self.lanes, self.rows, self.device = lanes, _rows(transitions), torch.device(device)

        def allocate(*shape: int, kind: torch.dtype) -> Tensor:
            if self.device.type != "cpu":
                return torch.zeros(shape, dtype=kind, device=self.device)
            # numpy leaves it to the system to clear pages when they are first written; torch writes them all
            # at once, for a gigabyte in a second or more.
            return torch.from_numpy(np.zeros(shape, array_of(torch.empty(0, dtype=kind)).dtype))

        self.fields: Fields = {
            "observation": allocate(lanes * self.rows, *observation_shape, kind=dtype),
            "action": allocate(transitions, lanes, *action_shape, kind=torch.int64),
            "reward": allocate(transitions, lanes, *reward_shape, kind=torch.float32),
            "done": allocate(transitions, lanes, kind=torch.bool),
            "terminated": allocate(transitions, lanes, kind=torch.bool),
            "row": allocate(transitions, lanes, kind=torch.int64),
        }
        """Observations [L x rows, ...], actions and rewards [T, L, ...], the rest [T, L]; `row` counts the
        observations that a lane has written. A state [L x rows, K] stands in the row of the observation that
        the lane saw next."""
        if state_cells:
            self.fields[STATE] = allocate(lanes * self.rows, state_cells, kind=torch.float32)
        self._of_rows = [name for name in self.fields if name in ("observation", STATE)]
        # Steps are written with numpy on the CPU: for so few numbers torch takes five times as long.
        self._arrays = {name: array_of(field) for name, field in self.fields.items()}
        self._lane = array_of(torch.arange(lanes, device=self.device))
        self._base = self._lane * self.rows
        self._begin()

    def _begin(self) -> None:
        """Resets to an empty storage."""
        zeros = torch.zeros(self.lanes, dtype=torch.int64, device=self.device)
        self._next_row, self._oldest = array_of(zeros), array_of(zeros.clone())
        self._begins, self._any_begins = array_of(zeros == 0), True
        self._written = 0

    @property
    def steps_after(self) -> int:
        """How many turns must have been written after one from which `get` can start."""
        return (self.sequence_steps if self.horizon is None else self.horizon.steps) - 1

    def __len__(self) -> int:
        """Transitions stored in the fullest lane."""
        return min(self._written, int(self.max_size))

    def oldest(self) -> tuple[Any, int]:
        """The number of each lane's oldest complete transition, int64 [L], a numpy array if the storage is on
        the CPU; and the number of the next transition to be written."""
        return _at_least(self._oldest, self._written - int(self.max_size)), self._written

    def set(self, cursor: Any, data: TensorDictBase, *, set_cursor: bool = True) -> None:
        """Writes the next transition of every lane; `cursor` is its position in the ring."""
        place = int(cursor[0] if isinstance(cursor, Sequence | Tensor) else cursor)
        if place != self._written % self.max_size:
            raise ValueError(
                f"cursor is {place}; allowed: the next position, {self._written % self.max_size}"
            )
        self.write(turn_of(data.reshape(self.lanes)))

    def write(self, turn: LaneTurn) -> None:
        """Writes the next transition of every lane, numpy arrays if the storage is on the CPU.

        Raises:
            ValueError: if observations have another dtype than the storage; they would be rounded.
        """
        arrays, place, row = self._arrays, self._written % self.max_size, self._next_row
        windows = arrays["observation"]
        if turn.observation.dtype != windows.dtype or turn.next_observation.dtype != windows.dtype:
            raise ValueError(
                f"observations are {turn.observation.dtype} and {turn.next_observation.dtype}; allowed: "
                f"{windows.dtype}, from Spaces.observation_dtype: make the learner with the Spaces of the "
                "transformed environment"
            )
        for name in self._of_rows:
            if self._any_begins:
                first = self._begins
                arrays[name][(self._base + row % self.rows)[first]] = getattr(turn, name)[first]
            arrays[name][self._base + (row + 1) % self.rows] = getattr(turn, f"next_{name}")
        arrays["action"][place] = turn.action
        arrays["reward"][place] = turn.reward
        arrays["done"][place] = turn.done
        arrays["terminated"][place] = turn.terminated
        arrays["row"][place] = row
        self._begins = turn.done | turn.terminated
        self._any_begins = _any(self._begins)
        self._next_row = row + 1 + self._begins if self._any_begins else row + 1
        self._written += 1
        if self._written % LOOKS_EVERY == 0:
            self._forget()

    def cut(self) -> None:
        """Ends the running episodes, as a time limit would: what is written next does not follow them."""
        if self._written:
            self._arrays["done"][(self._written - 1) % self.max_size] = True
            self._next_row = self._next_row + ~self._begins
            self._begins, self._any_begins = self._begins | True, True

    def _forget(self) -> None:
        """Excludes transitions whose observations are about to be overwritten from sampling."""
        oldest = _at_least(self._oldest, self._written - int(self.max_size))
        soon = self._next_row - self.rows + 2 * LOOKS_EVERY + 1
        while True:
            lost = self._arrays["row"][oldest % self.max_size, self._lane] <= soon
            lost &= oldest < self._written
            if not lost.any():
                break
            oldest += lost
        self._oldest = oldest

    def get(self, index: Tensor) -> TensorDict:
        """The transitions at positions [L, b] of the ring, or the sequences that begin there."""
        if self.sequence_steps > 1:
            return sequences(self.fields, index, self.rows, self.sequence_steps)
        return gather(self.fields, index, self.rows, self.horizon)

    def state_dict(self) -> dict[str, Any]:
        """The written part of all fields; once the storage is full, the tensors themselves, not copies."""
        kept = len(self)
        used = min(self.rows, int(self._next_row.max()) + 1)
        return {
            **{name: _part(array, array[:kept]) for name, array in self.fields.items()},
            **{name: _part(rows, rows[:, :used]) for name, rows in self._by_row().items()},
            "next_row": torch.as_tensor(self._next_row),
            "begins": torch.as_tensor(self._begins),
            "oldest": torch.as_tensor(self._oldest),
            "written": self._written,
        }

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Continues from the state of a storage with the same sizes."""
        by_row, stored = self._by_row(), state_dict["observation"]
        shape = by_row["observation"].shape
        if len(stored) != self.lanes or stored.shape[1] > self.rows or stored.shape[2:] != shape[2:]:
            allowed = [self.lanes, f"up to {self.rows}", *shape[2:]]
            raise ValueError(f"the state's observations are {list(stored.shape)}; allowed: {allowed}")
        for name, rows in by_row.items():
            rows[:, : state_dict[name].shape[1]] = state_dict[name]
        for name, array in self.fields.items():
            if name not in by_row:
                array[: len(state_dict[name])] = state_dict[name]
        own = {name: state_dict[name].to(self.device, copy=True) for name in ("next_row", "begins", "oldest")}
        self._next_row, self._begins = array_of(own["next_row"]), array_of(own["begins"])
        self._oldest, self._written = array_of(own["oldest"]), int(state_dict["written"])
        self._any_begins = bool(self._begins.any())

    def _by_row(self) -> Fields:
        """The fields of rows, [L, rows, ...]."""
        fields = {name: self.fields[name] for name in self._of_rows}
        return {name: field.view(self.lanes, self.rows, *field.shape[1:]) for name, field in fields.items()}

    def _empty(self) -> None:
        self._begin()


def _at_least(numbers: Any, lowest: int) -> Any:
    """`clip` from below; numpy's `clip` checks the limits of the dtype, which takes five times as long."""
    return np.maximum(numbers, lowest) if isinstance(numbers, np.ndarray) else numbers.clip(min=lowest)


def _any(flags: Any) -> bool:
    return bool(np.count_nonzero(flags) if isinstance(flags, np.ndarray) else flags.any())


def _part(whole: Tensor, part: Tensor) -> Tensor:
    """A copy of the part, because saving a view would write the whole tensor behind it."""
    return whole if part.shape == whole.shape else part.clone()
