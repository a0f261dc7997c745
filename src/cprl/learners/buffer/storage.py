"""LaneStorage: room for the transitions of many lanes, in which each window is kept once.

A lane is one agent of one replica. All lanes take a step together, so a transition is a row [L]; each lane
draws its own sample. The window that follows a transition is the one with which the next begins, and is
kept once; only where an episode ends it takes a place of its own.
"""

from collections.abc import Mapping, Sequence
from math import prod
from typing import Any, Final

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data.replay_buffers import Storage

from cprl.learners.transitions import LaneTurn, array_of

ENDS_PER_TRANSITION: Final = 0.02
"""Room for the last windows of episodes, beside that for transitions: one in fifty. Where episodes are
shorter than that, fewer transitions are kept; none is ever wrong."""

LOOKS_EVERY: Final = 32
"""Steps after which a storage looks again what is about to be written over."""

FIELDS: Final = ("observation", "action", "reward", "done", "terminated", "row")
"""What a storage holds, in the order in which it holds it."""

Fields = dict[str, Tensor]


def storage_bytes(
    lanes: int,
    transitions: int,
    observation_shape: Sequence[int],
    *,
    action_shape: Sequence[int] = (),
    item_bytes: int = 1,
) -> int:
    """Bytes that `LaneStorage` allocates.

    Args:
        lanes: L.
        transitions: kept for each lane, T.
        observation_shape: (C, X, Y).
        action_shape: of a lane's action.
        item_bytes: of one number of an observation.
    """
    windows = _rows(transitions) * prod(observation_shape) * item_bytes
    return lanes * (windows + transitions * (8 * prod(action_shape) + 4 + 8 + 1 + 1))


def _rows(transitions: int) -> int:
    """Windows for which a lane has room: those of its transitions, of ends, and of the steps until it looks
    again what has been written over, two a step at most."""
    return transitions + max(8, round(transitions * ENDS_PER_TRANSITION)) + 2 * LOOKS_EVERY + 2


class LaneStorage(Storage):
    """Room for T transitions of each of L lanes.

    Args:
        lanes: L.
        transitions: T.
        observation_shape: (C, X, Y); of a lane that is a team of S agents (S, C, X, Y).
        action_shape: of a lane's action: () of one agent, (S,) of a team.
        dtype: of observations.
        device: where it lies.

    What it is given and gives out are TensorDicts of the default keys: "observation", "action" and "next"
    with "observation", "reward", "done" and "terminated"; [L] or [1, L] a step, [L, b] a sample.
    """

    def __init__(
        self,
        *,
        lanes: int,
        transitions: int,
        observation_shape: Sequence[int],
        action_shape: Sequence[int] = (),
        dtype: torch.dtype = torch.uint8,
        device: str | torch.device = "cpu",
    ) -> None:
        super().__init__(transitions)
        self.lanes, self.rows, self.device = lanes, _rows(transitions), torch.device(device)
        self.shape_of_observation = tuple(observation_shape)

        def room(*shape: int, kind: torch.dtype) -> Tensor:
            return torch.zeros(shape, dtype=kind, device=self.device)

        self.fields: Fields = {
            "observation": room(lanes * self.rows, *observation_shape, kind=dtype),
            "action": room(transitions, lanes, *action_shape, kind=torch.int64),
            "reward": room(transitions, lanes, kind=torch.float32),
            "done": room(transitions, lanes, kind=torch.bool),
            "terminated": room(transitions, lanes, kind=torch.bool),
            "row": room(transitions, lanes, kind=torch.int64),
        }
        """Windows [L x rows, ...], the rest [T, L], actions [T, L, ...]; `row` counts the windows that a lane
        has written."""
        # Steps write through numpy where they can: on so few numbers torch takes five times as long.
        self._arrays = {name: array_of(field) for name, field in self.fields.items()}
        self._lane = array_of(torch.arange(lanes, device=self.device))
        self._base = self._lane * self.rows
        self._begin()

    def _begin(self) -> None:
        """Nothing has been written."""
        zeros = torch.zeros(self.lanes, dtype=torch.int64, device=self.device)
        self._next_row, self._oldest = array_of(zeros), array_of(zeros.clone())
        self._begins, self._any_begins = array_of(zeros == 0), True
        self._written = 0

    def __len__(self) -> int:
        """Transitions of the lane that holds most."""
        return min(self._written, int(self.max_size))

    def valid(self) -> tuple[Tensor, int]:
        """The number of each lane's oldest transition that is still whole, int64 [L], and of the next one."""
        oldest, written = self.oldest()
        return torch.as_tensor(oldest), written

    def oldest(self) -> tuple[Any, int]:
        """`valid`, as a numpy array where it lies on the CPU."""
        return _at_least(self._oldest, self._written - int(self.max_size)), self._written

    def set(self, cursor: Any, data: TensorDictBase, *, set_cursor: bool = True) -> None:
        """Writes the next transition of every lane; `cursor` is its place in the ring."""
        place = int(cursor[0] if isinstance(cursor, Sequence | Tensor) else cursor)
        if place != self._written % self.max_size:
            raise ValueError(f"the cursor is {place}; the next place is {self._written % self.max_size}")
        data = data.reshape(self.lanes)
        following = data.get("next")
        flags = (following.get(name).reshape(-1) for name in ("reward", "done", "terminated"))
        turn = data.get("observation"), data.get("action"), following.get("observation"), *flags
        self.write(LaneTurn(*map(array_of, turn)))

    def write(self, turn: LaneTurn) -> None:
        """Writes the next transition of every lane; numpy arrays where this storage lies on the CPU."""
        arrays, place, row = self._arrays, self._written % self.max_size, self._next_row
        windows = arrays["observation"]
        if self._any_begins:
            first = self._begins
            windows[(self._base + row % self.rows)[first]] = turn.observation[first]
        windows[self._base + (row + 1) % self.rows] = turn.next_observation
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

    def _forget(self) -> None:
        """Transitions whose windows are about to be written over are no longer drawn."""
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
        """The transitions at places [L, b] of the ring."""
        return gather(self.fields, index, self.rows)

    def state_dict(self) -> dict[str, Any]:
        """Everything that it holds, as far as it was written; once full the own tensors, not copies."""
        kept = len(self)
        windows = self.fields["observation"].view(self.lanes, self.rows, *self.shape_of_observation)
        used = min(self.rows, int(self._next_row.max()) + 1)
        return {
            **{name: _part(array, array[:kept]) for name, array in self.fields.items()},
            "observation": _part(windows, windows[:, :used]),
            "next_row": torch.as_tensor(self._next_row),
            "begins": torch.as_tensor(self._begins),
            "oldest": torch.as_tensor(self._oldest),
            "written": self._written,
        }

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Goes on where the storage of that state was, which had the same sizes."""
        windows = self.fields["observation"].view(self.lanes, self.rows, *self.shape_of_observation)
        came = state_dict["observation"]
        if len(came) != self.lanes or came.shape[1] > self.rows or came.shape[2:] != windows.shape[2:]:
            wanted = [self.lanes, f"up to {self.rows}", *self.shape_of_observation]
            raise ValueError(f"the state's windows are {list(came.shape)}; {wanted} is wanted")
        windows[:, : came.shape[1]] = came
        for name, array in self.fields.items():
            if name != "observation":
                array[: len(state_dict[name])] = state_dict[name]
        own = {name: state_dict[name].to(self.device, copy=True) for name in ("next_row", "begins", "oldest")}
        self._next_row, self._begins = array_of(own["next_row"]), array_of(own["begins"])
        self._oldest, self._written = array_of(own["oldest"]), int(state_dict["written"])
        self._any_begins = bool(self._begins.any())

    def _empty(self) -> None:
        self._begin()


def _at_least(numbers: Any, lowest: int) -> Any:
    """Numpy's own `clip` looks up the limits of the type first, which takes five times as long."""
    return np.maximum(numbers, lowest) if isinstance(numbers, np.ndarray) else numbers.clip(min=lowest)


def _any(flags: Any) -> bool:
    return bool(np.count_nonzero(flags) if isinstance(flags, np.ndarray) else flags.any())


def _part(whole: Tensor, part: Tensor) -> Tensor:
    """The part by itself, since a view is written to a file with all that it is a view of."""
    return whole if part.shape == whole.shape else part.clone()


def gather(fields: Fields, index: Tensor, rows: int) -> TensorDict:
    """Transitions at places [L, b] of a `LaneStorage`, as TorchRL's losses read them; changes nothing."""
    lanes, size = index.shape
    lane = torch.arange(lanes, device=index.device)[:, None]
    row = fields["row"][index, lane]
    windows = fields["observation"]
    shape = lanes, size, *windows.shape[1:]

    def seen(at: Tensor) -> Tensor:
        return windows.index_select(0, (lane * rows + at % rows).reshape(-1)).reshape(shape)

    def field(name: str) -> Tensor:
        return fields[name][index, lane].unsqueeze(-1)

    following = TensorDict(
        {
            "observation": seen(row + 1),
            "reward": field("reward"),
            "done": field("done"),
            "terminated": field("terminated"),
        },
        [lanes, size],
    )
    return TensorDict(
        {"observation": seen(row), "action": fields["action"][index, lane], "next": following}, [lanes, size]
    )
