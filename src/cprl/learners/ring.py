"""The replay buffer of many lanes, a ring that stores each observation once; each lane samples for itself.

A lane is one agent of one replica, and has a column for each of the W worlds in which it plays. All step
together, so the transitions of a turn are a row [C] of C = L x W columns. The observation after a transition
is also the one before the next transition, and is stored once. Only at the end of an episode it takes an
extra row. What is read are transitions, returns of several steps, or sequences, as TensorDicts with the keys
that TorchRL's losses read.
"""

import logging
from collections.abc import Mapping, Sequence
from math import prod
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from cprl import recurrent_state
from cprl.learners.draw import Draw
from cprl.learners.transitions import Horizon, LaneTurn, TransitionForm, array_of, refuse_other_dtype
from cprl.policies.rng import DRAWN_AHEAD, LaneRng
from cprl.system.memory import check_memory, free_bytes

FIELDS: Final = ("observation", "action", "reward", "done", "terminated", "row")
"""What a ring holds, in the order in which it holds it."""
STATE: Final = recurrent_state.AFTER
"""What a ring for sequences holds besides."""

Fields = dict[str, Tensor]


def gather(
    fields: Fields,
    index: Tensor,
    column: Tensor,
    rows: int,
    horizon: Horizon | None = None,
    noise: Tensor | None = None,
) -> TensorDict:
    """Transitions at places [L, b] of columns [L, b] or [L, 1] of a `Ring`, as TorchRL's losses read them;
    changes nothing. Uniform numbers [L, b, ...] become the entry "noise".

    With a horizon of n steps "reward" is the discounted sum of the rewards from there on: of n, or of those
    until the episode ends. What is "next" is that of the last of these steps, and "steps_to_next_obs", int64
    [L, b, 1], is their number, by which losses of TorchRL discount what they bootstrap from. The n - 1 steps
    that follow each place must have been written. TorchRL's `MultiStepTransform` gives the same, but for the
    flags "done" and "terminated", which it leaves those of the first step, so that it bootstraps from the
    observations at which episodes terminate.
    """
    row = fields["row"][index, column]
    windows = fields["observation"]
    shape = *index.shape, *windows.shape[1:]

    def seen(at: Tensor) -> Tensor:
        return windows.index_select(0, (column * rows + at % rows).reshape(-1)).reshape(shape)

    def field(name: str, place: Tensor) -> Tensor:
        return fields[name][place, column].unsqueeze(-1)

    last, last_row, reward = index, row, field("reward", index)
    more = {} if noise is None else {"noise": noise}
    if horizon is not None:
        last, reward, steps = _returns(fields, index, column, horizon)
        last_row = fields["row"][last, column]
        more["steps_to_next_obs"] = steps.unsqueeze(-1)
    following = TensorDict(
        {
            "observation": seen(last_row + 1),
            "reward": reward,
            "done": field("done", last),
            "terminated": field("terminated", last),
        },
        index.shape,
    )
    entries = {"observation": seen(row), "action": fields["action"][index, column], "next": following}
    return TensorDict({**entries, **more}, index.shape)


class _OfRing(NamedTuple):
    """Gathers transitions from the fields of a ring, then places, their columns and perhaps noise."""

    rows: int
    horizon: Horizon | None

    def __call__(self, columns: Sequence[Tensor]) -> TensorDict:
        index, column, *noise = columns[len(FIELDS) :]
        fields = dict(zip(FIELDS, columns, strict=False))
        return gather(fields, index, column, self.rows, self.horizon, *noise)


def sequences(fields: Fields, index: Tensor, column: Tensor, rows: int, steps: int) -> TensorDict:
    """Sequences [L, b, T] of T turns from places [L, b] of columns of a `Ring` on, for recurrent networks.

    Entries are those of `gather`, the states with which agents acted, "recurrent_state", float32
    [L, b, T, K], and "is_init", bool [L, b, T], as `cprl.networks.recurrent` says: where a sequence or an
    episode begins. Those of "next" are of the turns after; where a sequence begins, the turn after its first
    one does so too. The T - 1 turns that follow each place must have been written.
    """
    lanes, size = index.shape
    ahead = torch.arange(steps, device=index.device)
    places = ((index.unsqueeze(-1) + ahead) % len(fields["done"])).reshape(lanes, -1)
    column = column.expand(lanes, size).repeat_interleave(steps, 1)
    batch = gather(fields, places, column, rows)
    row, states = fields["row"][places, column], fields[STATE]
    for owner, at in ((batch, row), (batch["next"], row + 1)):
        rows_read = states.index_select(0, (column * rows + at % rows).reshape(-1))
        owner.set(STATE, rows_read.reshape(*places.shape, *states.shape[1:]))
    turns: TensorDict = batch.reshape(lanes, size, steps)
    ends = (turns["next", "done"] | turns["next", "terminated"]).squeeze(-1)
    is_init = torch.cat([torch.ones_like(ends[..., :1]), ends[..., :-1]], -1)
    return turns.set("is_init", is_init).set(("next", "is_init"), is_init.clone())


def _returns(
    fields: Fields, index: Tensor, column: Tensor, horizon: Horizon
) -> tuple[Tensor, Tensor, Tensor]:
    """From each place: the last place of its return [L, b], the return [L, b, 1], or [L, b, S, 1] of the
    members of a team, and its steps [L, b]."""
    places = len(fields["done"])

    def goes_on(place: Tensor) -> Tensor:
        return ~(fields["done"][place, column] | fields["terminated"][place, column])

    last, steps, going = index, torch.ones_like(index), goes_on(index)
    total = fields["reward"][index, column]
    of_members = (...,) + (None,) * (total.ndim - index.ndim)  # a world ends for all members of a team
    for step in range(1, horizon.steps):
        place = (index + step) % places
        total = total + going[of_members] * horizon.gamma**step * fields["reward"][place, column]
        last = torch.where(going, place, last)
        steps = steps + going
        going = going & goes_on(place)
    return last, total.unsqueeze(-1), steps


ENDS_PER_TRANSITION: Final = 0.02
"""Extra rows for the last observations of episodes: one per fifty transitions. With episodes shorter than 50
steps the buffer holds fewer transitions; those that it holds are always correct."""
LOOKS_EVERY: Final = 32
"""Steps between checks for transitions whose observations are about to be overwritten."""
NUMBERS_AHEAD: Final = 2**14
"""About as many numbers for losses that sample, or for an epoch, are generated at once for each lane."""


def _rows(turns: int) -> int:
    """Observation rows per column: one per turn, those for the ends of episodes, and at most two per turn
    until the next check for overwritten rows."""
    return turns + max(8, round(turns * ENDS_PER_TRANSITION)) + 2 * LOOKS_EVERY + 2


def stored_bytes(form: TransitionForm, columns: int, turns: int) -> int:
    """The bytes of so many turns of each of so many columns."""
    row = prod(form.observation_shape) * form.dtype.itemsize + 4 * form.state_cells
    beside = 8 * prod(form.action_shape) + 4 * prod(form.reward_shape) + 8 + 1 + 1
    return columns * (_rows(turns) * row + turns * beside)


def steps_ahead(count: int) -> int:
    """Steps whose numbers are generated at once, `count` for each: they are part of every checkpoint."""
    return min(DRAWN_AHEAD, max(1, NUMBERS_AHEAD // count))


class Noise:
    """Uniform numbers in 0..1 for losses that sample: a batch of them for each update and lane."""

    def __init__(
        self, seeds: Sequence[Sequence[int]], batch_size: int, shape: Sequence[int], device: torch.device
    ) -> None:
        self._size, self._device = (len(seeds), batch_size, *shape), device
        count = batch_size * prod(shape)
        self.rng = LaneRng(seeds, count, ahead=steps_ahead(count))

    def next(self) -> Tensor:
        return self.rng.next().view(self._size).to(self._device, torch.float32)


class Ring:
    """Stores the latest T turns of each of W worlds of L lanes, and samples uniformly from the T x W
    transitions of each lane, each lane for itself.

    Args:
        seeds: the sampling seed of each of the L lanes; a lane's samples depend on it alone.
        transitions: the capacity per lane, of which T x W are used.
        columns: where the worlds of each lane are written, int64 [L, W]; by default lane l, in one world, in
            column l.
        batch_size: transitions b sampled per lane, or sequences.
        noise_seeds: the seed of the noise of each lane; by default `seeds`.

    The size is logged before allocation, under "cprl", if it is a mebibyte or more.

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
        self.horizon, self.sequence_steps = form.horizon, form.sequence_steps
        self.device = torch.device(device)
        columns = torch.arange(len(seeds))[:, None] if columns is None else columns
        self.columns, count = columns.to(self.device), columns.numel()
        lanes, self.worlds = columns.shape
        self.capacity = turns = transitions // self.worlds
        """Turns T that are kept."""
        self.rows, self._ahead = _rows(turns), form.steps_ahead
        needed = stored_bytes(form, count, turns)
        what = f"{lanes} learners x {turns * self.worlds:,} transitions"
        check_memory(
            f"the replay buffers of {what}",
            needed,
            "a smaller buffer_size or fewer replicas",
            device=self.device,
        )
        if needed >= 2**20:
            sizes = needed / 2**30, free_bytes(self.device) / 2**30
            logging.getLogger("cprl").info("Replay buffers of %s: %.2f GiB of %.1f GiB free", what, *sizes)
        forms = {
            "observation": ((count * self.rows, *form.observation_shape), form.dtype),
            "action": ((turns, count, *form.action_shape), torch.int64),
            "reward": ((turns, count, *form.reward_shape), torch.float32),
            "done": ((turns, count), torch.bool),
            "terminated": ((turns, count), torch.bool),
            "row": ((turns, count), torch.int64),
            **({STATE: ((count * self.rows, form.state_cells), torch.float32)} if form.state_cells else {}),
        }
        self.fields: Fields = {name: _zeros(*of_field, self.device) for name, of_field in forms.items()}
        """Observations [C x rows, ...], actions and rewards [T, C, ...], the rest [T, C]; `row` counts the
        observations that a column has written. A state [C x rows, K] stands in the row of the observation
        that was seen next."""
        self.sizes = tuple((field.shape, field.dtype) for field in self.fields.values())
        self._of_rows = [name for name in self.fields if name in ("observation", STATE)]
        # Steps are written with numpy on the CPU: for so few numbers torch takes five times as long.
        self._arrays = {name: array_of(field) for name, field in self.fields.items()}
        self._column = array_of(torch.arange(count, device=self.device))
        self._base = self._column * self.rows
        zeros = torch.zeros(count, dtype=torch.int64, device=self.device)
        self._next_row, self._oldest = array_of(zeros), array_of(zeros.clone())
        self._begins, self._any_begins = array_of(zeros == 0), True
        self._written = 0
        self.rng, self.noise = LaneRng(seeds, batch_size), None
        if form.noise_shape:
            self.noise = Noise(noise_seeds or seeds, batch_size, form.noise_shape, self.device)

    def __len__(self) -> int:
        """Turns stored."""
        return min(self._written, self.capacity)

    def oldest(self) -> tuple[Any, int]:
        """The number of each column's oldest complete transition, int64 [C]; and that of the next one."""
        return _at_least(self._oldest, self._written - self.capacity), self._written

    def write(self, turn: LaneTurn) -> None:
        """Writes the next transition of every column, numpy arrays if the ring is on the CPU."""
        arrays, place, row = self._arrays, self._written % self.capacity, self._next_row
        for seen in (turn.observation, turn.next_observation):
            refuse_other_dtype(seen.dtype, arrays["observation"].dtype)
        first = self._begins
        for name in self._of_rows:
            if self._any_begins:
                arrays[name][(self._base + row % self.rows)[first]] = getattr(turn, name)[first]
            arrays[name][self._base + (row + 1) % self.rows] = getattr(turn, f"next_{name}")
        for name in ("action", "reward", "done", "terminated"):
            arrays[name][place] = getattr(turn, name)
        arrays["row"][place] = row
        self._begins = begins = turn.done | turn.terminated
        self._any_begins = bool(np.count_nonzero(begins) if isinstance(begins, np.ndarray) else begins.any())
        self._next_row = row + 1 + self._begins if self._any_begins else row + 1
        self._written += 1
        if self._written % LOOKS_EVERY == 0:
            self._forget()

    def cut(self) -> None:
        """Ends the running episodes, as a time limit would: what is written next does not follow them."""
        if self._written:
            self._arrays["done"][(self._written - 1) % self.capacity] = True
            self._next_row = self._next_row + ~self._begins
            self._begins, self._any_begins = self._begins | True, True

    def _forget(self) -> None:
        """Excludes transitions whose observations are about to be overwritten from sampling."""
        self._oldest, soon = self.oldest()[0], self._next_row - self.rows + 2 * LOOKS_EVERY + 1
        while True:
            lost = self._arrays["row"][self._oldest % self.capacity, self._column] <= soon
            lost &= self._oldest < self._written
            if not lost.any():
                break
            self._oldest += lost

    def places(self) -> tuple[Tensor, Tensor]:
        """The places of the next sample, int64 [L, b], and their columns, [L, b], or [L, 1] in one world."""
        oldest, written = self.oldest()
        written -= self._ahead  # the newest transitions have no full return or sequence yet
        numbers = array_of(self.rng.next().to(self.device))
        if self.worlds > 1:
            return self._draw_of_worlds(torch.as_tensor(oldest), written, torch.as_tensor(numbers))
        shares = numbers * (written - oldest)[:, None]
        # numpy on the CPU: for so few numbers torch takes three times as long.
        numbers = shares.astype(np.int64) if isinstance(shares, np.ndarray) else shares.long()
        return torch.as_tensor((oldest[:, None] + numbers) % self.capacity), self.columns

    def _draw_of_worlds(self, oldest: Tensor, written: int, numbers: Tensor) -> tuple[Tensor, Tensor]:
        """As `places`, from numbers in 0..1, [L, b]: all turns of a lane's worlds one after the other."""
        ends = (written - oldest[self.columns]).clamp(min=0).cumsum(1)
        at = (numbers * ends[:, -1:]).long()
        world = torch.searchsorted(ends, at, right=True)
        place = written - (ends.gather(1, world) - at)
        return place % self.capacity, self.columns.gather(1, world)

    def get(self, index: Tensor, column: Tensor | None = None) -> TensorDict:
        """The transitions at places [L, b] of columns, those of the first worlds by default, or the sequences
        that begin there."""
        column = self.columns[:, :1] if column is None else column
        if self.sequence_steps > 1:
            return sequences(self.fields, index, column, self.rows, self.sequence_steps)
        return gather(self.fields, index, column, self.rows, self.horizon)

    def sample(self) -> TensorDict:
        """The next sample: transitions [L, b], or sequences, with the entry "noise" if the loss samples."""
        batch = self.get(*self.places())
        if self.noise is not None:
            batch.set("noise", self.noise.next())
        return batch

    def draw(self) -> Draw:
        """The next sample, not yet gathered; sequences are."""
        if self.sequence_steps > 1:
            return Draw.of(self.sample())
        index, column = self.places()
        noise = [] if self.noise is None else [self.noise.next()]
        columns = [*self.fields.values(), index, column, *noise]
        return Draw(_OfRing(self.rows, self.horizon), columns, (self.sizes, index.shape))

    def state_dict(self) -> dict[str, Any]:
        """The written part of all fields, and the states of random numbers; once the ring is full, the
        tensors themselves, not copies."""
        written = len(self)
        used = min(self.rows, int(self._next_row.max()) + 1)
        stored = {
            **{name: _part(array, array[:written]) for name, array in self.fields.items()},
            **{name: _part(rows, rows[:, :used]) for name, rows in self._by_row().items()},
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
        by_row, stored = self._by_row(), state["storage"]
        for name, rows in by_row.items():
            rows[:, : stored[name].shape[1]] = stored[name]
        for name, array in self.fields.items():
            if name not in by_row:
                array[: len(stored[name])] = stored[name]
        self._next_row, self._begins, self._oldest = (
            array_of(stored[name].to(self.device, copy=True)) for name in ("next_row", "begins", "oldest")
        )
        self._written, self._any_begins = int(stored["written"]), bool(self._begins.any())

    def _by_row(self) -> Fields:
        """The fields of rows, [C, rows, ...]."""
        fields = {name: self.fields[name] for name in self._of_rows}
        return {name: field.view(-1, self.rows, *field.shape[1:]) for name, field in fields.items()}


def _zeros(shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    if device.type != "cpu":
        return torch.zeros(shape, dtype=dtype, device=device)
    # numpy leaves it to the system to clear pages when they are first written; torch writes them all at once,
    # for a gigabyte in a second or more.
    return torch.from_numpy(np.zeros(shape, array_of(torch.empty(0, dtype=dtype)).dtype))


def _at_least(numbers: Any, lowest: int) -> Any:
    """`clip` from below; numpy's `clip` checks the limits of the dtype, which takes five times as long."""
    return np.maximum(numbers, lowest) if isinstance(numbers, np.ndarray) else numbers.clip(min=lowest)


def _part(whole: Tensor, part: Tensor) -> Tensor:
    """A copy of the part, because saving a view would write the whole tensor behind it."""
    return whole if part.shape == whole.shape else part.clone()
