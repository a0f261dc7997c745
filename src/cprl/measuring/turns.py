"""TurnReader: the turns of a collector's batches, as arrays."""

from collections.abc import Collection
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase

from cprl import keys
from cprl.measuring import institutional

Array = NDArray[Any]
Turns = dict[str, Array]
"""The entries of one turn or several, [B, ...] or [B, T, ...], by the last part of their keys."""


class TurnReader:
    """Reads the turns of batches that have the same entries, worlds and agents.

    Args:
        reported: the optional entries that the game reports, see `cprl.measuring.reported`.
        worlds: the number of worlds B of a batch.
        agents: the number of agents N of each world.
        widths: see `institutional.widths_in`.
    """

    def __init__(
        self, reported: Collection[str], *, worlds: int, agents: int, widths: institutional.Widths
    ) -> None:
        self._worlds, self._agents, self._widths = worlds, agents, widths
        of_worlds = tuple(name for name in reported if name in ("stock", "in_force"))
        self._of_agents = ("reward", *(name for name in reported if name not in ("in_play", *of_worlds)))
        self._of_worlds = (*of_worlds, keys.TERMINATED, keys.DONE)
        self._has_in_play = "in_play" in reported
        self._checked: torch.Size | None = None

    def read(self, tensordict: TensorDictBase) -> Turns:
        """All entries as arrays, [B, ...] or [B, T, ...], without a copy if the batch is on the CPU.

        "had_ended", the worlds that had ended before the turn, is included only if a world has ended now.

        Raises:
            ValueError: if the batch lacks an entry, or has a wrong shape.
        """
        try:
            turns = self._arrays(tensordict)
        except KeyError as error:
            raise self._missing(tensordict) from error
        if tensordict.batch_size != self._checked:
            self._check(turns, tensordict.batch_size)
        return turns

    def _arrays(self, tensordict: TensorDictBase) -> Turns:
        following, entry = keys.entry(tensordict, "next"), keys.entry
        agents = entry(following, keys.AGENTS)
        tensors = {name: entry(agents, name) for name in self._of_agents}
        tensors |= {name: entry(following, name) for name in self._of_worlds}
        if self._has_in_play:
            tensors["in_play"] = entry(entry(tensordict, keys.AGENTS), "in_play")
        had_ended = entry(tensordict, keys.DONE)
        turns = {name: tensor.numpy(force=True) for name, tensor in tensors.items()}
        if np.count_nonzero(turns["done"]):  # a tenth of the time that `any` takes on so few
            turns["had_ended"] = had_ended.numpy(force=True)
            if tensordict.get(keys.BALLOTS_DUE, None) is not None:
                turns["decision"] = entry(entry(tensordict, keys.AGENTS), "decision").numpy(force=True)
        return turns

    def _missing(self, tensordict: TensorDictBase) -> ValueError:
        """The error for a batch that lacks an entry."""
        needed: dict[Any, str] = {keys.DONE: "done"}
        needed |= {("next", name): f"next, {name}" for name in self._of_worlds}
        needed |= {("next", keys.AGENTS, name): f"next, agents, {name}" for name in self._of_agents}
        if self._has_in_play:
            needed[keys.IN_PLAY] = "agents, in_play"
        missing = [f"({name})" for key, name in needed.items() if tensordict.get(key, None) is None]
        return ValueError(
            f"the batch lacks {', '.join(missing)}; allowed: batches with rewards, done and terminated, "
            "and the optional entries of the first batch"
        )

    def _check(self, turns: Turns, size: torch.Size) -> None:
        """Checks the shapes of a batch, once per batch size, because checking takes longer than counting."""
        if len(size) not in (1, 2) or size[0] != self._worlds:
            raise ValueError(f"the batch is {list(size)}; allowed: [{self._worlds}] or [{self._worlds}, T]")
        one, agents = (1,), (self._agents,)
        own: dict[str, tuple[int, ...]] = dict.fromkeys(("harvest", "fired", "in_play", "decision"), agents)
        own |= {"reward": agents + one, "hit_by": agents * 2, "tagged_by": agents * 2}
        own |= institutional.shapes(self._agents, self._widths)
        for name, array in turns.items():
            allowed = (*size, *own.get(name, one))
            if array.shape != allowed:
                raise ValueError(f'"{name}" of the batch is {list(array.shape)}; allowed: {list(allowed)}')
        self._checked = size
