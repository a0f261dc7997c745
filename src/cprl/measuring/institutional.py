"""What an `EpisodeTracker` keeps of the institutions of a game while episodes are running."""

from collections.abc import Collection, Mapping, Sequence
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from cprl import keys
from cprl.envs.unwrap import commons_of
from cprl.institutions import COUNTS, Institution
from cprl.measuring import institutions
from cprl.measuring.reported import INSTITUTIONAL, OF_INSTITUTIONS

Array = NDArray[Any]
Widths = Mapping[str, int]

STATE: Final = {entry: (name,) for name, entry in INSTITUTIONAL.items()}
"""The arrays that a tracker stores for each entry, by their names in its state."""
WIDE: Final = ("counts", "in_force")
"""The entries whose last axis is not that of agents: C counts, V decisions."""


def institutions_of(env: EnvBase) -> tuple[Institution, ...]:
    """The institutions of a game of cprl, transforms or not; () for another."""
    commons = commons_of(env)
    return () if commons is None else commons.game.institutions


def metrics_of(env: EnvBase, reported: Collection[str]) -> tuple[str, ...]:
    """The metrics of institutions in episodes of an environment that reports these entries."""
    if set(reported).isdisjoint(OF_INSTITUTIONS):
        return ()
    return tuple(
        name
        for name in institutions.metrics_for(institutions_of(env))
        if set(institutions.NEEDS[name]) <= set(reported)
    )


def decisions_of(env: EnvBase) -> tuple[str, ...]:
    """What is decided in an episode, in words, in the order of "in_force"."""
    commons = commons_of(env)
    if commons is not None and commons.game.ballots:
        return tuple(ballot.title for ballot in commons.game.ballots)
    (width,) = env.observation_spec[keys.IN_FORCE].shape[env.batch_dims :]
    return tuple(f"decision {nth}" for nth in range(width))


def widths_in(tensordict: TensorDictBase) -> dict[str, int]:
    """C and V of a batch, by the names of `WIDE`.

    Raises:
        ValueError: if it has other counts than `cprl.institutions.COUNTS`.
    """
    places: dict[str, Any] = {"counts": ("next", *keys.COUNTS), "in_force": ("next", keys.IN_FORCE)}
    found = {name: tensordict.get(place, None) for name, place in places.items()}
    widths = {name: values.shape[-1] for name, values in found.items() if values is not None}
    if widths.get("counts", len(COUNTS)) != len(COUNTS):
        raise ValueError(
            f'"counts" of the batch has {widths["counts"]} columns; allowed: {len(COUNTS)}, '
            f"{', '.join(COUNTS)}"
        )
    return widths


def widths_of(state: Mapping[str, Tensor]) -> dict[str, int]:
    """C and V of a tracker's state."""
    return {name: state[name].shape[-1] for name in WIDE if name in state and state[name].ndim}


def arrays(reported: Collection[str], worlds: int, agents: int, widths: Widths) -> dict[str, Array]:
    """The arrays that a tracker stores for these entries, by `STATE`, all 0."""
    of_each = (worlds, agents)
    made: dict[str, Array] = {
        "fines": np.zeros(of_each, np.float64),
        "transfers": np.zeros(of_each, np.float64),
        "violations": np.zeros(of_each, np.int64),
        "counts": np.zeros((*of_each, widths.get("counts", 0)), np.int64),
        "in_force": np.zeros((worlds, widths.get("in_force", 0)), np.float64),
    }
    return {name: made[name] for entry, (name,) in STATE.items() if entry in reported}


def shapes(agents: int, widths: Widths) -> dict[str, tuple[int, ...]]:
    """The shapes of the entries, without batch axes."""
    counts, in_force = (widths.get(name, 0) for name in WIDE)
    own: dict[str, tuple[int, ...]] = dict.fromkeys(("fines", "transfers", "violated"), (agents,))
    return {**own, "counts": (agents, counts), "in_force": (in_force,)}


def count(running: Mapping[str, Array], turn: Mapping[str, Array]) -> None:
    """Adds a turn of all worlds to the arrays of `arrays`; `running["steps"]` counts it already."""
    for name in ("fines", "transfers"):
        if name in turn:
            running[name] += turn[name]
    if "violated" in turn and np.count_nonzero(turn["violated"]):
        running["violations"] += turn["violated"]
    if "counts" in turn:  # they are cumulative: the last turn's are those of the episode
        running["counts"][:] = turn["counts"]
    if "in_force" in turn:
        first = running["steps"] == 1
        if np.count_nonzero(first):
            running["in_force"][first] = turn["in_force"][first]


def fields_of(ended: Mapping[str, Array], index: int, of_game: Sequence[Institution]) -> dict[str, Any]:
    """The fields of `Episode` about institutions of one of the episodes that end, from their arrays."""
    fields: dict[str, Any] = {name: ended[name][index] for name in INSTITUTIONAL if name in ended}
    if "counts" in fields:
        counted = institutions.counts_for(of_game)
        fields["counts"] = {name: fields["counts"][:, COUNTS.index(name)] for name in counted}
    return fields


def measured(
    ended: Mapping[str, Array],
    *,
    harvest: Array | None,
    in_play_steps: Array | None,
    of_game: Sequence[Institution],
) -> dict[str, Tensor]:
    """The metrics of the E episodes that end, [E] by name; empty for a game without institutions.

    Args:
        ended: their arrays in the tracker's state.
        harvest: float64 [E, N]; None without the entry.
        in_play_steps: int64 [E, N], likewise.
        of_game: the institutions of the game, which tell what concerns it and which agents belong together.
    """
    if not any(name in ended for name in INSTITUTIONAL):
        return {}
    given: dict[str, Any] = {
        name: ended[name] for name in ("fines", "transfers", "violations") if name in ended
    }
    given |= {"harvest": harvest, "in_play_steps": in_play_steps}
    given["tags"] = ended["tagged_by"].sum(1) if "tagged_by" in ended else None
    known = {name: torch.from_numpy(values) for name, values in given.items() if values is not None}
    counts = (
        {name: torch.from_numpy(ended["counts"][..., column]) for column, name in enumerate(COUNTS)}
        if "counts" in ended
        else None
    )
    found = institutions.summary(**known, counts=counts, groups=institutions.groups_of(of_game))
    return {name: found[name] for name in institutions.metrics_for(of_game) if name in found}
