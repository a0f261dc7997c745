"""Collects whole episodes from the batches of a collector."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor

from cprl import arguments
from cprl.institutions import Institution
from cprl.measuring import institutional
from cprl.measuring.ended import episodes_of
from cprl.measuring.episode import Episode
from cprl.measuring.institutions import check_groups, groups_of
from cprl.measuring.reported import OF_INSTITUTIONS, OPTIONAL, reported_in
from cprl.measuring.turns import Array, TurnReader, Turns
from cprl.system.memory import check_memory

__all__ = ["Episode", "EpisodeTracker"]

_STATE: Final = {
    "harvest": ("harvest",),
    "in_play": ("in_play",),
    "fired": ("shots",),
    "hit_by": ("hit_by",),
    "tagged_by": ("tagged", "tagged_by"),
    "stock": ("depletion_step",),
    **institutional.STATE,
}
"""The arrays that a tracker stores for each optional entry, by their names in its state."""
_HISTORIES: Final = {"harvest": np.float32, "in_play": np.bool_}
"""Entries that are stored for every step of an episode, with their dtypes."""
_FIRST_CAPACITY_STEPS: Final = 128
"""The initial capacity of histories, in steps, without max_steps."""
_LARGEST_FIRST_CAPACITY_STEPS: Final = 4096
"""The largest initial capacity, however large max_steps is; histories grow with the episodes."""
_WORLDS_AT_ONCE: Final = 64
"""Episodes measured together: more are faster, but the history of each is held in float64."""


class EpisodeTracker:
    """Tracks the running episode of each world and returns it when it ends.

    The first batch determines which optional entries (`cprl.measuring.reported`) the game reports; every
    later batch must have them. Fields and metrics that need other entries are left out of episodes.

    Args:
        worlds: the number of worlds B of a batch.
        agents: the number of agents N of each world.
        max_steps: the maximum length of an episode, e.g. `Rules.episode_steps`; None if it is unknown.
        sustainable_yield: apples per step that the map can sustain; with first_stock, adds yield_share.
        first_stock: apples on the board at the start of an episode.
        institutions: those of the game, which tell what is measured of them, see
            `cprl.measuring.institutions.metrics_for`.

    Raises:
        ValueError: if a number is no integer or below 1; in `add`, if a batch has a wrong shape or lacks an
            entry, or an episode is longer than max_steps.
        MemoryError: if there are too many worlds.
    """

    def __init__(
        self,
        worlds: int,
        agents: int,
        max_steps: int | None = None,
        *,
        sustainable_yield: float | None = None,
        first_stock: float | None = None,
        institutions: Sequence[Institution] = (),
    ) -> None:
        worlds = arguments.integer("worlds", worlds, 1, 2**32)
        agents = arguments.integer("agents", agents, 1, 2**20)
        max_steps = None if max_steps is None else arguments.integer("max_steps", max_steps, 1)
        self.worlds, self.agents, self.max_steps = worlds, agents, max_steps
        needed = worlds * agents * (5 * self._capacity(0) + 16 * agents)
        check_memory(f"worlds is {worlds:,}: the histories of their episodes", needed, "fewer worlds")
        self.reported: tuple[str, ...] | None = None
        """The optional entries of this game; None before the first batch."""
        self._yield = {"sustainable_yield": sustainable_yield, "first_stock": first_stock}
        self._institutions: tuple[Institution, ...] = arguments.objects(
            "institutions", institutions, Institution, "a value of cprl.institutions"
        )
        groups = groups_of(self._institutions)
        if groups is not None:
            check_groups(groups, agents)
        self._widths: institutional.Widths = {}
        self._every_world = np.arange(worlds)
        self._episode = np.zeros(worlds, np.int64)
        self._has_institutions = False
        self._reader = TurnReader((), worlds=worlds, agents=agents, widths={})
        self._histories: dict[str, Array] = {}
        self._running: dict[str, Array] = {}

    def add(self, tensordict: TensorDictBase) -> list[Episode]:
        """Adds the next turns of all worlds, batch size [B] or [B, T], with the entries of `cprl.keys`.

        Returns:
            The episodes that ended, ordered by turn, then by world.
        """
        if self.reported is None:
            arguments.object_of("tensordict", tensordict, TensorDictBase, "a TensorDict with the next turns")
            self._begin(reported_in(tensordict), institutional.widths_in(tensordict))
        turns, size = self._reader.read(tensordict), tensordict.batch_size
        if len(size) == 1:
            return self._add_turn(turns)
        episodes = []
        for turn in range(size[1]):
            episodes += self._add_turn({name: array[:, turn] for name, array in turns.items()})
        return episodes

    @property
    def returns(self) -> NDArray[np.float64]:
        """A copy of the returns so far of the running episodes, [B, N]; zeros before the first turn."""
        kept = self._running.get("return")
        return np.zeros((self.worlds, self.agents)) if kept is None else kept.copy()

    def state_dict(self) -> dict[str, Tensor]:
        """Copies of the arrays of the running episodes, up to the steps played."""
        longest = int(self._running["steps"].max()) if self._running else 0
        return {name: torch.tensor(array) for name, array in self._arrays(longest).items()}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Continues exactly from a state that `state_dict` returned.

        Raises:
            ValueError: if the state has other shapes, or is from a game that reports other entries; the
                tracker is then unchanged.
        """
        arguments.object_of("state", state, Mapping, "a value of state_dict()")
        for name, tensor in state.items():
            arguments.object_of(f"state[{name!r}]", tensor, Tensor, "a tensor")
        longest = next((state[name].shape[1] for name in _HISTORIES if name in state), 0)
        if self.max_steps is not None and longest > self.max_steps:
            raise ValueError(f"the state has {longest} steps; allowed: up to max_steps, {self.max_steps}")
        reported = None  # the tracker had seen no batch
        if "steps" in state:
            reported = tuple(entry for entry in (*OPTIONAL, *OF_INSTITUTIONS) if _STATE[entry][0] in state)
            if self.reported not in (None, reported):
                raise ValueError(
                    f"the state is from a game that reports {list(reported)}; allowed: "
                    f"{list(self.reported or ())}, as this game reports"
                )
        other = EpisodeTracker(
            self.worlds, self.agents, self.max_steps, **self._yield, institutions=self._institutions
        )
        if reported is not None:
            widths = institutional.widths_of(state) if self.reported is None else self._widths
            other._begin(reported, widths, capacity=longest)
        arrays = other._arrays(longest)
        if not set(arrays) <= set(state):
            raise ValueError(f"the state has {sorted(state)}; allowed: at least {sorted(arrays)}")
        for name, array in arrays.items():
            if state[name].shape != array.shape:
                allowed = list(array.shape)
                raise ValueError(f'"{name}" of the state is {list(state[name].shape)}; allowed: {allowed}')
        for name, array in arrays.items():
            array[:] = state[name].numpy(force=True)
        vars(self).update(vars(other))

    def _arrays(self, longest: int) -> dict[str, Array]:
        histories = {name: array[:, :longest] for name, array in self._histories.items()}
        return {"episode": self._episode, **histories, **self._running}

    def _begin(self, reported: tuple[str, ...], widths: institutional.Widths, *, capacity: int = 0) -> None:
        """Allocates the arrays for a game that reports these entries."""
        if "harvest" not in reported and self._yield["sustainable_yield"] is not None:
            raise ValueError(
                "sustainable_yield is given; allowed: None, because yield_share needs a harvest, which the "
                "game does not report"
            )
        self.reported, self._widths = reported, widths
        worlds, agents = self.worlds, self.agents
        steps = self._capacity(capacity)
        self._histories = {
            name: np.zeros((worlds, steps, agents), dtype)
            for name, dtype in _HISTORIES.items()
            if name in reported
        }
        shapes: dict[str, tuple[int, ...]] = {
            "depletion_step": (worlds,),
            "shots": (worlds, agents),
            "tagged": (worlds, agents),
            "hit_by": (worlds, agents, agents),
            "tagged_by": (worlds, agents, agents),
        }
        kept = {name for entry in reported for name in _STATE[entry]}
        self._running = {
            "steps": np.zeros(worlds, np.int64),
            "return": np.zeros((worlds, agents), np.float64),
            **{name: np.zeros(shape, np.int64) for name, shape in shapes.items() if name in kept},
            **institutional.arrays(reported, worlds, agents, widths),
        }
        self._has_institutions = not set(reported).isdisjoint(OF_INSTITUTIONS)
        self._reader = TurnReader(reported, worlds=worlds, agents=agents, widths=widths)

    def _capacity(self, steps: int) -> int:
        """The initial capacity of histories, in steps, at least `steps`."""
        if self.max_steps is None:
            return max(steps, _FIRST_CAPACITY_STEPS)
        return max(steps, min(self.max_steps, _LARGEST_FIRST_CAPACITY_STEPS))

    def _add_turn(self, turn: Turns) -> list[Episode]:
        self._count(turn)
        if "had_ended" not in turn:
            return []
        done = turn["done"][:, 0]
        # A world that had ended before and is stepped again does not end a second time.
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
            for name, history in self._histories.items():
                history[place] = turn[name]
        except IndexError:
            self._grow()
            for name, history in self._histories.items():
                history[place] = turn[name]
        if not self._histories and self.max_steps is not None and steps.max() >= self.max_steps:
            self._grow()
        steps += 1
        running["return"] += turn["reward"][..., 0]
        if "fired" in turn:
            running["shots"] += turn["fired"]
        if "hit_by" in turn and np.count_nonzero(turn["hit_by"]):
            running["hit_by"] += turn["hit_by"]
        if "tagged_by" in turn and np.count_nonzero(turn["tagged_by"]):
            running["tagged"] += turn["tagged_by"].any(-1)
            running["tagged_by"] += turn["tagged_by"]
        if "stock" in turn and np.count_nonzero(turn["stock"]) < turn["stock"].size:
            depletion_step = running["depletion_step"]
            just_now = (turn["stock"][:, 0] == 0) & (depletion_step == 0)
            depletion_step[just_now] = steps[just_now]
        if self._has_institutions:
            institutional.count(running, turn)

    def _grow(self) -> None:
        """Doubles the capacity of histories, up to max_steps; raises a ValueError beyond it."""
        most = self.max_steps
        if most is not None and self._running["steps"].max() >= most:
            world = int(self._running["steps"].argmax())
            raise ValueError(
                f"the episode of world {world} has not ended after {most} steps; "
                f"allowed: up to max_steps of EpisodeTracker, which no episode may exceed"
            ) from None
        for name, history in self._histories.items():
            more = np.zeros_like(history[:, : None if most is None else most - history.shape[1]])
            self._histories[name] = np.concatenate([history, more], axis=1)

    def _measure(self, worlds: Array, turn: Turns) -> Iterator[Episode]:
        """The episodes of the worlds, int64 [E], that end with this turn."""
        longest = self._running["steps"][worlds].max()
        return episodes_of(
            worlds,
            numbers=self._episode[worlds],
            ended={name: array[worlds] for name, array in self._running.items()},
            histories={name: array[worlds, :longest] for name, array in self._histories.items()},
            turn=turn,
            of_yield=self._yield,
            of_game=self._institutions,
        )
