"""Episodes that have ended, out of what an `EpisodeTracker` stored of them."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
import torch

from cprl.institutions import Institution
from cprl.measuring import institutional, social
from cprl.measuring.episode import Episode
from cprl.measuring.turns import Array, Turns

_AS_COUNTED: Final = ("shots", "tagged", "tagged_by")
"""Fields of an episode that are copied from the tracker's state unchanged."""


def episodes_of(
    worlds: Array,
    *,
    numbers: Array,
    ended: Mapping[str, Array],
    histories: Mapping[str, Array],
    turn: Turns,
    of_yield: Mapping[str, float | None],
    of_game: Sequence[Institution],
) -> Iterator[Episode]:
    """The E episodes that end with a turn.

    Args:
        worlds: int64 [E], the indices of their worlds.
        numbers: int64 [E], the indices of the episodes in their worlds.
        ended: the counts of each episode by their names in the tracker's state, [E, ...].
        histories: harvest and in_play, [E, T, N], where the game reports them; their padding is not read.
        turn: the last turn of all worlds, [B, ...].
        of_yield: sustainable_yield and first_stock, see `cprl.measuring.social.summary`.
        of_game: the institutions of the game.
    """
    played = np.arange(ended["steps"].max()) < ended["steps"][:, None]
    kept = {name: array[:, : played.shape[1]] for name, array in histories.items()}
    if "harvest" in kept:
        kept["harvest"] = np.where(played[..., None], kept["harvest"], 0)
    if "in_play" in kept:
        kept["in_play"] = played[..., None] & kept["in_play"]
    steps = {name: torch.from_numpy(array) for name, array in kept.items()}
    metrics = social.summary(
        steps.get("harvest"), steps.get("in_play"), played=torch.from_numpy(played), **of_yield
    )
    harvest = kept["harvest"].sum(1, dtype=np.float64) if "harvest" in kept else None
    in_play_steps = kept["in_play"].sum(1) if "in_play" in kept else None
    came = institutional.measured(ended, harvest=harvest, in_play_steps=in_play_steps, of_game=of_game)
    for k, world in enumerate(worlds):
        fields: dict[str, Any] = {name: ended[name][k] for name in _AS_COUNTED if name in ended}
        if harvest is not None:
            fields["harvest"] = harvest[k]
        if in_play_steps is not None:
            fields["in_play_steps"] = in_play_steps[k]
        if "hit_by" in ended:
            fields["hits"] = ended["hit_by"][k].sum(0)
        if "decision" in turn:
            fields["decision"] = turn["decision"][world].copy()
        if "stock" in turn:
            fields["stock_left"] = int(turn["stock"][world, 0])
            fields["depletion_step"] = int(ended["depletion_step"][k]) or -1
        yield Episode(
            world=int(world),
            episode=int(numbers[k]),
            steps=int(ended["steps"][k]),
            terminated=bool(turn["terminated"][world, 0]),
            return_=ended["return"][k],
            metrics={name: float(values[k]) for name, values in metrics.items()},
            institutions={name: float(values[k]) for name, values in came.items()},
            **fields,
            **institutional.fields_of(ended, k, of_game),
        )
