"""Whole episodes out of the batches that a collector yields."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor

from cprl import keys
from cprl.measuring import social

Array = NDArray[Any]
Turns = dict[str, Array]

_OF_AGENTS: Final = (keys.REWARD, keys.HARVEST, keys.FIRED, keys.HIT_BY, keys.TAGGED_BY)
_OF_WORLDS: Final = (keys.STOCK, keys.TERMINATED, keys.DONE)
_WORLDS_AT_ONCE: Final = 64
"""Episodes measured together: the more, the faster, but each brings its whole history in float64."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Episode:
    """One episode of one world, from its first step to its end. Steps are counted from 1."""

    world: int
    """The index of the world in its batch."""
    episode: int
    """The episodes that this world had ended before."""
    steps: int
    """Steps played, at least 1."""
    terminated: bool
    """No apple was left and none could come; else the clock ran out."""
    return_: NDArray[np.float64]
    """[N], the sum of rewards: what the learner was paid, undiscounted."""
    harvest: NDArray[np.float64]
    """[N], apples bitten."""
    in_play_steps: NDArray[np.int64]
    """[N], steps whose action counted."""
    shots: NDArray[np.int64]
    """[N], beams fired."""
    hits: NDArray[np.int64]
    """[N], how many agents one's beams crossed, summed over the steps."""
    tagged: NDArray[np.int64]
    """[N], how many times one was tagged out; by two in one step is one time."""
    tagged_by: NDArray[np.int64]
    """[N, N], row: tagged, column: how many times by whom."""
    stock_left: int
    """Apples on the board at the end."""
    depletion_step: int
    """The first step that left no apple on the board, or -1."""
    metrics: dict[str, float]
    """`social.summary` of the episode; NaN where undefined."""


class EpisodeTracker:
    """Keeps each world's running episode and hands it out when it ends.

    Args:
        worlds: how many worlds B a batch holds.
        agents: agents N of each world.
        max_steps: no episode is longer, `Rules.episode_steps`.
        sustainable_yield: apples per step that the map can bear; with first_stock, metrics hold yield_share.
        first_stock: apples on the board as an episode begins.

    Raises:
        ValueError: for numbers below 1; in `add`, for a batch that does not fit and for an episode that
            is longer than max_steps.
    """

    def __init__(
        self,
        worlds: int,
        agents: int,
        max_steps: int,
        *,
        sustainable_yield: float | None = None,
        first_stock: float | None = None,
    ) -> None:
        for name, number in (("worlds", worlds), ("agents", agents), ("max_steps", max_steps)):
            if number < 1:
                raise ValueError(f"{name} is {number}; at least 1 is wanted")
        self.worlds, self.agents, self.max_steps = worlds, agents, max_steps
        self._yield = {"sustainable_yield": sustainable_yield, "first_stock": first_stock}
        self._every_world = np.arange(worlds)
        self._checked: torch.Size | None = None
        self._episode = np.zeros(worlds, np.int64)
        self._harvest = np.zeros((worlds, max_steps, agents), np.float32)
        self._in_play = np.zeros((worlds, max_steps, agents), np.bool_)
        self._running: dict[str, Array] = {
            "steps": np.zeros(worlds, np.int64),
            "depletion_step": np.zeros(worlds, np.int64),
            "return": np.zeros((worlds, agents), np.float64),
            "shots": np.zeros((worlds, agents), np.int64),
            "tagged": np.zeros((worlds, agents), np.int64),
            "hit_by": np.zeros((worlds, agents, agents), np.int64),
            "tagged_by": np.zeros((worlds, agents, agents), np.int64),
        }

    def add(self, tensordict: TensorDictBase) -> list[Episode]:
        """Takes the next turns of all worlds, batch size [B] or [B, T'], with the entries of `cprl.keys`.

        Returns:
            The episodes that ended, in the order of turns, then of worlds.
        """
        turns, size = _read(tensordict), tensordict.batch_size
        if size != self._checked:
            self._check(turns, size)
        if len(size) == 1:
            return self._add_turn(turns)
        episodes = []
        for turn in range(size[1]):
            episodes += self._add_turn({name: array[:, turn] for name, array in turns.items()})
        return episodes

    def state_dict(self) -> dict[str, Tensor]:
        """Copies of all that the running episodes are made of, as far as they have been played."""
        longest = int(self._running["steps"].max())
        return {name: torch.tensor(array) for name, array in self._arrays(longest).items()}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Goes on exactly where the tracker of that `state_dict` was."""
        longest = state["harvest"].shape[1]
        if longest > self.max_steps:
            raise ValueError(f"the state holds {longest} steps; max_steps is {self.max_steps}")
        arrays = self._arrays(longest)
        for name, array in arrays.items():
            if state[name].shape != array.shape:
                wanted = list(array.shape)
                raise ValueError(f'"{name}" of the state is {list(state[name].shape)}; {wanted} is wanted')
        for name, array in arrays.items():
            array[:] = state[name].numpy(force=True)

    def _arrays(self, longest: int) -> dict[str, Array]:
        histories = {"harvest": self._harvest[:, :longest], "in_play": self._in_play[:, :longest]}
        return {"episode": self._episode, **histories, **self._running}

    def _check(self, turns: Turns, size: torch.Size) -> None:
        """That a batch fits; once for every batch size, since checking takes longer than counting."""
        if len(size) not in (1, 2) or size[0] != self.worlds:
            raise ValueError(f"the batch is {list(size)}; [{self.worlds}] or [{self.worlds}, T] is wanted")
        one, agents = (1,), (self.agents,)
        own: dict[str, tuple[int, ...]] = dict.fromkeys(("harvest", "fired", "in_play"), agents)
        own |= {"reward": agents + one, "hit_by": agents * 2, "tagged_by": agents * 2}
        for name, array in turns.items():
            wanted = (*size, *own.get(name, one))
            if array.shape != wanted:
                raise ValueError(f'"{name}" of the batch is {list(array.shape)}; {list(wanted)} is wanted')
        self._checked = size

    def _add_turn(self, turn: Turns) -> list[Episode]:
        self._count(turn)
        if not np.count_nonzero(turn["done"]):  # a tenth of the time that `any` takes on so few
            return []
        done = turn["done"][:, 0]
        ended = np.flatnonzero(done & ~turn["had_ended"][:, 0])
        episodes: list[Episode] = []
        for first in range(0, len(ended), _WORLDS_AT_ONCE):
            episodes.extend(self._measure(ended[first : first + _WORLDS_AT_ONCE], turn))
        self._episode[ended] += 1
        for array in self._running.values():
            array[done] = 0
        return episodes

    def _count(self, turn: Turns) -> None:
        running, steps = self._running, self._running["steps"]
        place = self._every_world, steps
        try:
            self._harvest[place] = turn["harvest"]
        except IndexError:
            raise ValueError(
                f"the episode of world {int(steps.argmax())} has not ended after {self.max_steps} steps; "
                f"give EpisodeTracker a max_steps that no episode exceeds"
            ) from None
        self._in_play[place] = turn["in_play"]
        steps += 1
        running["return"] += turn["reward"][..., 0]
        running["shots"] += turn["fired"]
        if np.count_nonzero(turn["hit_by"]):
            running["hit_by"] += turn["hit_by"]
        if np.count_nonzero(turn["tagged_by"]):
            running["tagged"] += turn["tagged_by"].any(-1)
            running["tagged_by"] += turn["tagged_by"]
        if np.count_nonzero(turn["stock"]) < turn["stock"].size:
            depletion_step = running["depletion_step"]
            just_now = (turn["stock"][:, 0] == 0) & (depletion_step == 0)
            depletion_step[just_now] = steps[just_now]

    def _measure(self, worlds: Array, turn: Turns) -> Iterator[Episode]:
        """The episodes of the worlds, int64 [E], that end with this turn."""
        ended = {name: array[worlds] for name, array in self._running.items()}
        played = np.arange(ended["steps"].max()) < ended["steps"][:, None]
        harvest = np.where(played[..., None], self._harvest[worlds, : played.shape[1]], 0)
        in_play = played[..., None] & self._in_play[worlds, : played.shape[1]]
        metrics = social.summary(
            torch.from_numpy(harvest),
            torch.from_numpy(in_play),
            played=torch.from_numpy(played),
            **self._yield,
        )
        for k, world in enumerate(worlds):
            yield Episode(
                world=int(world),
                episode=int(self._episode[world]),
                steps=int(ended["steps"][k]),
                terminated=bool(turn["terminated"][world, 0]),
                return_=ended["return"][k],
                harvest=harvest[k].sum(0, dtype=np.float64),
                in_play_steps=in_play[k].sum(0),
                shots=ended["shots"][k],
                hits=ended["hit_by"][k].sum(0),
                tagged=ended["tagged"][k],
                tagged_by=ended["tagged_by"][k],
                stock_left=int(turn["stock"][world, 0]),
                depletion_step=int(ended["depletion_step"][k]) or -1,
                metrics={name: float(values[k]) for name, values in metrics.items()},
            )


def _read(tensordict: TensorDictBase) -> Turns:
    """Every entry once, [B, ...] or [B, T', ...], without a copy where the batch lies on the CPU."""
    following, entry = keys.entry(tensordict, "next"), keys.entry
    agents, before = entry(following, keys.AGENTS), entry(tensordict, keys.AGENTS)
    tensors = {name: entry(agents, name) for _, name in _OF_AGENTS}
    tensors |= {name: entry(following, name) for name in _OF_WORLDS}
    tensors["in_play"] = entry(before, keys.IN_PLAY[1])
    # In a world that had ended before and is stepped all the same nothing happens: it ends no second time.
    tensors["had_ended"] = entry(tensordict, keys.DONE)
    return {name: tensor.numpy(force=True) for name, tensor in tensors.items()}
