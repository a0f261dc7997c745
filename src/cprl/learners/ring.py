"""Ring: the replay buffer of many lanes, which stores each observation once.

A lane is one agent of one replica, or a team, and has a column for each of the W worlds in which it plays.
All worlds step together, so the transitions of a turn are one place of the ring: a row [C] of C = L x W
columns. The observation after a transition is also the observation before the next one, and is stored once.
So observations have rows of their own, and an episode's end takes an extra row for its last observation.

Each lane samples from its own columns: transitions, returns of several steps, or sequences, as TensorDicts
with the keys that TorchRL's losses read.
"""

import logging
from collections.abc import Mapping, Sequence
from math import prod
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from cprl.keys import recurrent_state
from cprl.learners.draw import Draw
from cprl.learners.transitions import Horizon, LaneTurn, Sizes, TransitionForm, array_of, refuse_other_dtype
from cprl.policies.rng import DRAWN_AHEAD, LaneRng
from cprl.system.memory import check_memory, free_bytes

_STATE: Final = recurrent_state.AFTER
"""The name of the field with recurrent states, which a ring for sequences has besides."""
_ROW_FIELDS: Final = ("observation", _STATE)
"""The names of the fields that have rows of their own, see `Ring.fields`."""

Fields = dict[str, Tensor]
"""The fields of a ring by name, see `Ring.fields`."""


def gather(
    fields: Fields,
    index: Tensor,
    column: Tensor,
    rows: int,
    horizon: Horizon | None = None,
    noise: Tensor | None = None,
) -> TensorDict:
    """Return transitions of a `Ring`, [L, b], as TorchRL's losses read them.

    With a horizon of n steps, "reward" is the discounted sum of n rewards, or of fewer if the episode ends
    sooner; "next" is what follows the last of these steps; and "steps_to_next_obs", int64 [L, b, 1], is their
    number, by which TorchRL's losses discount the value that they bootstrap from. TorchRL's
    `MultiStepTransform` computes the same, except that it keeps the flags "done" and "terminated" of the
    first step, and so bootstraps from observations at which episodes have terminated.

    Args:
        fields: the fields of the ring.
        index: the places of the transitions, int64 [L, b]. With a horizon of n steps, the n - 1 turns after
            each place must have been written.
        column: their columns, int64 [L, b] or [L, 1].
        rows: the observation rows of each column.
        horizon: the steps and the discount of returns; None for single steps.
        noise: uniform numbers [L, b, ...] for the entry "noise"; None for none.
    """
    last = index
    reward = fields["reward"][index, column].unsqueeze(-1)
    row = fields["row"][index, column]
    last_row = row
    optional = {} if noise is None else {"noise": noise}
    if horizon is not None:
        last, reward, steps = _returns(fields, index, column, horizon)
        last_row = fields["row"][last, column]
        optional["steps_to_next_obs"] = steps.unsqueeze(-1)
    observation = fields["observation"]
    next_entries = TensorDict(
        {
            "observation": _select_rows(observation, column, last_row + 1, rows),
            "reward": reward,
            "done": fields["done"][last, column].unsqueeze(-1),
            "terminated": fields["terminated"][last, column].unsqueeze(-1),
        },
        index.shape,
    )
    entries = {
        "observation": _select_rows(observation, column, row, rows),
        "action": fields["action"][index, column],
        "next": next_entries,
    }
    return TensorDict({**entries, **optional}, index.shape)


def _select_rows(field: Tensor, column: Tensor, row: Tensor, rows: int) -> Tensor:
    """Return the entries of a field that has rows, [C x rows, ...], for columns and rows [L, b].

    Args:
        row: counts the rows that a column has written; it wraps around after `rows`.
    """
    selected = field.index_select(0, (column * rows + row % rows).reshape(-1))
    return selected.reshape(*row.shape, *field.shape[1:])


class _Gather(NamedTuple):
    """A function that gathers the batch of a `Draw`: `gather`, or `sequences`, with what does not change
    filled in."""

    names: tuple[str, ...]
    """The names of the fields of the ring, in the order in which it holds them."""
    rows: int
    horizon: Horizon | None
    sequence_steps: int

    def __call__(self, columns: Sequence[Tensor]) -> TensorDict:
        """Return the transitions, [L, b], or the sequences that begin with them, [L, b, T].

        Args:
            columns: the fields of the ring, then the places of the transitions, their columns, and, for
                losses that sample, uniform numbers.
        """
        fields = dict(zip(self.names, columns, strict=False))
        index, column, *noise = columns[len(fields) :]
        if self.sequence_steps > 1:
            return sequences(fields, index, column, self.rows, self.sequence_steps)
        return gather(fields, index, column, self.rows, self.horizon, *noise)


def sequences(fields: Fields, index: Tensor, column: Tensor, rows: int, steps: int) -> TensorDict:
    """Return sequences of T turns of a `Ring`, [L, b, T], for recurrent networks.

    Besides the entries of `gather` they have "recurrent_state", float32 [L, b, T, K], the states with which
    agents acted, and "is_init", bool [L, b, T], which marks the turns with which a sequence or an episode
    begins, see `cprl.networks.recurrent`. "next" has both entries of the turn after, too: there the first
    turn of a sequence is marked as well.

    Args:
        index: the places of the first turns, int64 [L, b]; the T - 1 turns after each must have been written.
        column: their columns, int64 [L, b] or [L, 1].
        rows: the observation rows of each column.
        steps: the turns T of a sequence.
    """
    lanes, size = index.shape
    ahead = torch.arange(steps, device=index.device)
    places = ((index.unsqueeze(-1) + ahead) % len(fields["done"])).reshape(lanes, -1)
    column = column.expand(lanes, size).repeat_interleave(steps, 1)
    batch = gather(fields, places, column, rows)
    row = fields["row"][places, column]
    batch.set(_STATE, _select_rows(fields[_STATE], column, row, rows))
    batch["next"].set(_STATE, _select_rows(fields[_STATE], column, row + 1, rows))
    turns: TensorDict = batch.reshape(lanes, size, steps)
    ends = (turns["next", "done"] | turns["next", "terminated"]).squeeze(-1)
    is_init = torch.cat([torch.ones_like(ends[..., :1]), ends[..., :-1]], -1)
    return turns.set("is_init", is_init).set(("next", "is_init"), is_init.clone())


def _returns(
    fields: Fields, index: Tensor, column: Tensor, horizon: Horizon
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the discounted sum of the rewards from each place on, up to the horizon or the episode's end.

    Returns:
        The place of the last step that is summed, [L, b]; the sum, [L, b, 1], or [L, b, S, 1] for the members
        of a team; and the number of steps, [L, b].
    """
    capacity = len(fields["done"])
    last = index
    steps = torch.ones_like(index)
    continues = _episode_continues(fields, index, column)
    total = fields["reward"][index, column]
    member_axes = (...,) + (None,) * (total.ndim - index.ndim)  # an episode ends for all members of a team
    for step in range(1, horizon.steps):
        place = (index + step) % capacity
        total = total + continues[member_axes] * horizon.gamma**step * fields["reward"][place, column]
        last = torch.where(continues, place, last)
        steps = steps + continues
        continues = continues & _episode_continues(fields, place, column)
    return last, total.unsqueeze(-1), steps


def _episode_continues(fields: Fields, place: Tensor, column: Tensor) -> Tensor:
    """Return whether the episode goes on after the turns at some places, bool [L, b]."""
    return ~(fields["done"][place, column] | fields["terminated"][place, column])


SPARE_ROWS_SHARE: Final = 0.02
"""The share of extra rows for the last observations of episodes: one for fifty transitions. If episodes are
shorter than 50 steps, rows run out before places, and the buffer holds fewer transitions than its capacity;
those that it holds are correct."""
CHECK_EVERY_TURNS: Final = 32
"""Turns between checks for transitions whose observations are about to be overwritten."""
RANDOM_NUMBERS_PER_BLOCK: Final = 2**14
"""About the number of random numbers that are generated at once for each lane, for losses that sample and for
the order of an epoch's minibatches."""


def _rows_per_column(turns: int) -> int:
    """Return the observation rows that a column of some turns needs: one per turn, spare rows for the ends of
    episodes, and two per turn until the next check for overwritten rows."""
    return turns + max(8, round(turns * SPARE_ROWS_SHARE)) + 2 * CHECK_EVERY_TURNS + 2


def _sizes(form: TransitionForm, columns: int, turns: int) -> Sizes:
    """Return the shape and the dtype of each field of a ring, see `Ring.fields`."""
    fields = form.fields
    del fields["next_observation"]  # it is the observation of the next row
    fields["row"] = (), torch.int64
    if form.state_cells:
        fields[_STATE] = (form.state_cells,), torch.float32
    sizes = {}
    for name, (shape, dtype) in fields.items():
        axes = (columns * _rows_per_column(turns),) if name in _ROW_FIELDS else (turns, columns)
        sizes[name] = (*axes, *shape), dtype
    return sizes


def stored_bytes(form: TransitionForm, columns: int, turns: int) -> int:
    """Return the bytes that a ring of some columns and turns takes."""
    return sum(prod(shape) * dtype.itemsize for shape, dtype in _sizes(form, columns, turns).values())


def steps_per_block(count: int) -> int:
    """Return the steps whose random numbers are generated at once, `count` for each step.

    Every checkpoint holds the numbers that are not used yet, so there are not too many.
    """
    return min(DRAWN_AHEAD, max(1, RANDOM_NUMBERS_PER_BLOCK // count))


class Noise:
    """A generator of uniform numbers in 0..1 for losses that sample: a batch of them for each update.

    Args:
        seeds: the seed of each lane.
        shape: the shape of the numbers of one transition.
    """

    def __init__(
        self, seeds: Sequence[Sequence[int]], batch_size: int, shape: Sequence[int], device: torch.device
    ) -> None:
        self._size = (len(seeds), batch_size, *shape)
        self._device = device
        count = batch_size * prod(shape)
        self.rng = LaneRng(seeds, count, ahead=steps_per_block(count))

    def next(self) -> Tensor:
        """Return the numbers of the next update, float32 [L, b, *shape]."""
        return self.rng.next().view(self._size).to(self._device, torch.float32)


class Ring:
    """A replay buffer of the latest T turns of each of W worlds of L lanes.

    Each lane samples uniformly from its own T x W transitions.

    Args:
        form: the shapes of what is stored of a turn and sampled.
        seeds: the sampling seed of each of the L lanes; a lane's samples depend on it alone.
        transitions: the capacity per lane; of it the largest multiple of W, T x W, is used.
        batch_size: the transitions, or sequences, b that are sampled per lane.
        columns: the columns of each lane's worlds, int64 [L, W]; by default lane l has one world, column l.
        noise_seeds: the seed of the noise of each lane; by default `seeds`.
        device: the torch device of the stored turns.

    A size of a mebibyte or more is logged, under "cprl", before it is allocated.

    Raises:
        TooLargeError: if the device has less free memory than needed; raised before anything is allocated.
    """

    def __init__(
        self,
        form: TransitionForm,
        *,
        seeds: Sequence[Sequence[int]],
        transitions: int,
        batch_size: int,
        columns: Tensor | None = None,
        noise_seeds: Sequence[Sequence[int]] | None = None,
        device: str | torch.device = "cpu",
    ) -> None:
        self.device = torch.device(device)
        columns = torch.arange(len(seeds))[:, None] if columns is None else columns
        self.columns = columns.to(self.device)
        column_count = columns.numel()
        lanes, self.worlds = columns.shape
        self.capacity = transitions // self.worlds
        """The turns T that are kept."""
        self.rows = _rows_per_column(self.capacity)
        """The observation rows of each column."""
        self._steps_ahead = form.steps_ahead
        _refuse_too_large(form, lanes, self.worlds, self.capacity, self.device)
        sizes = _sizes(form, column_count, self.capacity)
        self.sizes = tuple(sizes.values())
        """The shapes and dtypes of the fields."""
        self.fields = {name: _zeros(shape, dtype, self.device) for name, (shape, dtype) in sizes.items()}
        """Observations [C x rows, ...], actions and rewards [T, C, ...], flags [T, C].

        "row", [T, C], counts the rows that a column has written; the observation before a turn has this row,
        that after it the next one. A recurrent state, [C x rows, K], has the row of the observation before
        the turn in which the agent acted with it."""
        self._gather = _Gather(tuple(sizes), self.rows, form.horizon, form.sequence_steps)
        self._row_fields = [name for name in self.fields if name in _ROW_FIELDS]
        # Turns are written with numpy on the CPU: for so few numbers torch takes five times as long.
        self._arrays = {name: array_of(field) for name, field in self.fields.items()}
        self._column = array_of(torch.arange(column_count, device=self.device))
        self._first_row = self._column * self.rows
        zeros = torch.zeros(column_count, dtype=torch.int64, device=self.device)
        self._next_row = array_of(zeros)
        """The row of the observation before the next turn, [C]."""
        self._oldest = array_of(zeros.clone())
        """The number of the oldest turn whose observations are still complete, [C]."""
        self._begins = array_of(zeros == 0)
        """Marks the columns in which an episode begins with the next turn, [C]."""
        self._any_begins = True
        self._written = 0
        """The turns written so far, also those that were overwritten since."""
        self.rng = LaneRng(seeds, batch_size)
        self.noise = None
        if form.noise_shape:
            self.noise = Noise(noise_seeds or seeds, batch_size, form.noise_shape, self.device)

    def __len__(self) -> int:
        """Return the number of turns stored."""
        return min(self._written, self.capacity)

    def oldest(self) -> tuple[Any, int]:
        """Return the number of each column's oldest complete turn, int64 [C], and that of the next turn."""
        return _clip_below(self._oldest, self._written - self.capacity), self._written

    def write(self, turn: LaneTurn) -> None:
        """Write the next transition of every column; its fields are numpy arrays if the ring is on the
        CPU."""
        arrays = self._arrays
        place = self._written % self.capacity
        row = self._next_row
        for observation in (turn.observation, turn.next_observation):
            refuse_other_dtype(observation.dtype, arrays["observation"].dtype)
        begins = self._begins
        for name in self._row_fields:
            if self._any_begins:  # elsewhere the turn before has written this row
                arrays[name][(self._first_row + row % self.rows)[begins]] = getattr(turn, name)[begins]
            arrays[name][self._first_row + (row + 1) % self.rows] = getattr(turn, f"next_{name}")
        for name in ("action", "reward", "done", "terminated"):
            arrays[name][place] = getattr(turn, name)
        arrays["row"][place] = row
        ended = turn.done | turn.terminated
        self._begins = ended
        self._any_begins = bool(np.count_nonzero(ended) if isinstance(ended, np.ndarray) else ended.any())
        # The last observation of an episode keeps its row; the next episode begins in the row after it.
        self._next_row = row + 1 + ended if self._any_begins else row + 1
        self._written += 1
        if self._written % CHECK_EVERY_TURNS == 0:
            self._exclude_overwritten()

    def cut(self) -> None:
        """End the running episodes, as a time limit would: the next turn does not follow the latest one."""
        if self._written:
            self._arrays["done"][(self._written - 1) % self.capacity] = True
            self._next_row = self._next_row + ~self._begins
            self._begins = self._begins | True
            self._any_begins = True

    def _exclude_overwritten(self) -> None:
        """Exclude from sampling the turns whose observations will be overwritten before the next check."""
        self._oldest, _ = self.oldest()
        last_lost_row = self._next_row - self.rows + 2 * CHECK_EVERY_TURNS + 1
        while True:
            is_lost = self._arrays["row"][self._oldest % self.capacity, self._column] <= last_lost_row
            is_lost &= self._oldest < self._written
            if not is_lost.any():
                break
            self._oldest += is_lost

    def places(self) -> tuple[Tensor, Tensor]:
        """Draw the places of the next sample, int64 [L, b], and their columns, [L, b], or [L, 1] if lanes
        have one world."""
        oldest, next_turn = self.oldest()
        next_turn -= self._steps_ahead  # the latest turns have no complete return or sequence yet
        numbers = array_of(self.rng.next().to(self.device))
        if self.worlds > 1:
            return self._places_in_worlds(torch.as_tensor(oldest), next_turn, torch.as_tensor(numbers))
        scaled = numbers * (next_turn - oldest)[:, None]
        # numpy on the CPU: for so few numbers torch takes three times as long.
        offsets = scaled.astype(np.int64) if isinstance(scaled, np.ndarray) else scaled.long()
        return torch.as_tensor((oldest[:, None] + offsets) % self.capacity), self.columns

    def _places_in_worlds(self, oldest: Tensor, next_turn: int, numbers: Tensor) -> tuple[Tensor, Tensor]:
        """Return the places and columns that numbers in 0..1, [L, b], choose among the turns of a lane's
        worlds, which are counted one world after the other."""
        ends = (next_turn - oldest[self.columns]).clamp(min=0).cumsum(1)
        chosen = (numbers * ends[:, -1:]).long()
        world = torch.searchsorted(ends, chosen, right=True)
        place = next_turn - (ends.gather(1, world) - chosen)
        return place % self.capacity, self.columns.gather(1, world)

    def get(self, index: Tensor, column: Tensor | None = None) -> TensorDict:
        """Return transitions, [L, b], or the sequences that begin with them, [L, b, T].

        Args:
            index: their places, int64 [L, b].
            column: their columns, int64 [L, b] or [L, 1]; by default those of each lane's first world.
        """
        column = self.columns[:, :1] if column is None else column
        return self._gather([*self.fields.values(), index, column])

    def sample(self) -> TensorDict:
        """Return the next sample: transitions [L, b], or sequences [L, b, T]; with the entry "noise" for
        losses that sample."""
        draw = self.draw()
        return draw.gather(draw.columns)

    def draw(self) -> Draw:
        """Return the next sample as a `Draw`, which the update gathers itself."""
        index, column = self.places()
        noise = [] if self.noise is None else [self.noise.next()]
        columns = [*self.fields.values(), index, column, *noise]
        return Draw(self._gather, columns, (self.sizes, index.shape))

    def state_dict(self) -> dict[str, Any]:
        """Return the written part of all fields, and the states of the random generators.

        Tensors are copied only as long as the ring is not full.
        """
        turns = len(self)
        rows = min(self.rows, int(self._next_row.max()) + 1)
        stored = {
            **{name: _copy_part(field, field[:turns]) for name, field in self.fields.items()},
            **{name: _copy_part(field, field[:, :rows]) for name, field in self._by_row().items()},
            "next_row": torch.as_tensor(self._next_row),
            "begins": torch.as_tensor(self._begins),
            "oldest": torch.as_tensor(self._oldest),
            "written": self._written,
        }
        noise = {} if self.noise is None else {"noise": self.noise.rng.state_dict()}
        return {"storage": stored, "sampler": self.rng.state_dict(), **noise}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.rng.load_state_dict(state["sampler"])
        if self.noise is not None:
            self.noise.rng.load_state_dict(state["noise"])
        by_row = self._by_row()
        stored = state["storage"]
        for name, rows in by_row.items():
            rows[:, : stored[name].shape[1]] = stored[name]
        for name, array in self.fields.items():
            if name not in by_row:
                array[: len(stored[name])] = stored[name]
        self._next_row, self._begins, self._oldest = (
            array_of(stored[name].to(self.device, copy=True)) for name in ("next_row", "begins", "oldest")
        )
        self._written = int(stored["written"])
        self._any_begins = bool(self._begins.any())

    def _by_row(self) -> Fields:
        """Return the fields that have rows, as views [C, rows, ...]."""
        fields = {name: self.fields[name] for name in self._row_fields}
        return {name: field.view(-1, self.rows, *field.shape[1:]) for name, field in fields.items()}


def _refuse_too_large(
    form: TransitionForm, lanes: int, worlds: int, turns: int, device: torch.device
) -> None:
    """Raise a TooLargeError if the device has too little free memory for a ring; log the size of a large
    one."""
    needed_bytes = stored_bytes(form, lanes * worlds, turns)
    size = f"{lanes} learners x {turns * worlds:,} transitions"
    check_memory(
        f"the replay buffers of {size}",
        needed_bytes,
        "a smaller buffer_size or fewer replicas",
        device=device,
    )
    if needed_bytes >= 2**20:
        needed = needed_bytes / 2**30
        free = free_bytes(device) / 2**30
        logging.getLogger("cprl").info("Replay buffers of %s: %.2f GiB of %.1f GiB free", size, needed, free)


def _zeros(shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return zeros; on the CPU without writing them.

    For numpy's zeros the operating system clears each page of memory when it is first written. Torch writes
    all pages at once, which takes a second or more for a gigabyte.
    """
    if device.type != "cpu":
        return torch.zeros(shape, dtype=dtype, device=device)
    return torch.from_numpy(np.zeros(shape, array_of(torch.empty(0, dtype=dtype)).dtype))


def _clip_below(numbers: Any, lowest: int) -> Any:
    """Raise numbers below a limit to the limit; numpy's `clip` checks the limits of the dtype, which takes
    five times as long."""
    return np.maximum(numbers, lowest) if isinstance(numbers, np.ndarray) else numbers.clip(min=lowest)


def _copy_part(field: Tensor, part: Tensor) -> Tensor:
    """Return a copy of a part of a field, because saving a view would save the whole field; return the field
    itself if the part is all of it."""
    return field if part.shape == field.shape else part.clone()
