"""What is read from a `LaneStorage`: transitions, returns of several steps, or sequences."""

from typing import Final, NamedTuple

import torch
from tensordict import TensorDict
from torch import Tensor

FIELDS: Final = ("observation", "action", "reward", "done", "terminated", "row")
"""What a storage holds, in the order in which it holds it."""

STATE: Final = "recurrent_state"
"""What a storage for sequences holds besides."""

Fields = dict[str, Tensor]


class Horizon(NamedTuple):
    """Returns of several steps: how many rewards they sum, and by which discount."""

    steps: int
    gamma: float


def gather(fields: Fields, index: Tensor, rows: int, horizon: Horizon | None = None) -> TensorDict:
    """Transitions at places [L, b] of a `LaneStorage`, as TorchRL's losses read them; changes nothing.

    With a horizon of n steps "reward" is the discounted sum of the rewards from there on: of n, or of those
    until the episode ends. What is "next" is that of the last of these steps, and "steps_to_next_obs", int64
    [L, b, 1], is their number, by which losses of TorchRL discount what they bootstrap from. The n - 1 steps
    that follow each place must have been written. TorchRL's `MultiStepTransform` gives the same, but for the
    flags "done" and "terminated", which it leaves those of the first step, so that it bootstraps from the
    observations at which episodes terminate.
    """
    lanes, size = index.shape
    lane = torch.arange(lanes, device=index.device)[:, None]
    row = fields["row"][index, lane]
    windows = fields["observation"]
    shape = lanes, size, *windows.shape[1:]

    def seen(at: Tensor) -> Tensor:
        return windows.index_select(0, (lane * rows + at % rows).reshape(-1)).reshape(shape)

    def field(name: str, place: Tensor) -> Tensor:
        return fields[name][place, lane].unsqueeze(-1)

    last, last_row, reward = index, row, field("reward", index)
    more = {}
    if horizon is not None:
        last, reward, steps = _returns(fields, index, lane, horizon)
        last_row = fields["row"][last, lane]
        more["steps_to_next_obs"] = steps.unsqueeze(-1)
    following = TensorDict(
        {
            "observation": seen(last_row + 1),
            "reward": reward,
            "done": field("done", last),
            "terminated": field("terminated", last),
        },
        [lanes, size],
    )
    entries = {"observation": seen(row), "action": fields["action"][index, lane], "next": following}
    return TensorDict({**entries, **more}, [lanes, size])


def sequences(fields: Fields, index: Tensor, rows: int, steps: int) -> TensorDict:
    """Sequences [L, b, T] of T turns from places [L, b] of a `LaneStorage` on, for recurrent networks.

    Entries are those of `gather`, the states with which agents acted, "recurrent_state", float32
    [L, b, T, K], and "is_init", bool [L, b, T], as `cprl.networks.recurrent` says: where a sequence or an
    episode begins. Those of "next" are of the turns after; where a sequence begins, the turn after its first
    one does so too. The T - 1 turns that follow each place must have been written.
    """
    lanes, size = index.shape
    ahead = torch.arange(steps, device=index.device)
    places = ((index.unsqueeze(-1) + ahead) % len(fields["done"])).reshape(lanes, -1)
    batch = gather(fields, places, rows)
    lane = torch.arange(lanes, device=index.device)[:, None]
    row, states = fields["row"][places, lane], fields[STATE]
    for owner, at in ((batch, row), (batch["next"], row + 1)):
        found = states.index_select(0, (lane * rows + at % rows).reshape(-1))
        owner.set(STATE, found.reshape(*places.shape, *states.shape[1:]))
    turns: TensorDict = batch.reshape(lanes, size, steps)
    ends = (turns["next", "done"] | turns["next", "terminated"]).squeeze(-1)
    is_init = torch.cat([torch.ones_like(ends[..., :1]), ends[..., :-1]], -1)
    return turns.set("is_init", is_init).set(("next", "is_init"), is_init.clone())


def sampled(
    fields: Fields, index: Tensor, rows: int, horizon: Horizon | None, noise: Tensor | None
) -> TensorDict:
    """`gather`, with uniform numbers [L, b, ...] as the entry "noise" for losses that sample, or without."""
    batch = gather(fields, index, rows, horizon)
    if noise is not None:
        batch.set("noise", noise)
    return batch


def _returns(fields: Fields, index: Tensor, lane: Tensor, horizon: Horizon) -> tuple[Tensor, Tensor, Tensor]:
    """From each place: the last place of its return [L, b], the return [L, b, 1], or [L, b, S, 1] of the
    members of a team, and its steps [L, b]."""
    places = len(fields["done"])

    def goes_on(place: Tensor) -> Tensor:
        return ~(fields["done"][place, lane] | fields["terminated"][place, lane])

    last, steps, going = index, torch.ones_like(index), goes_on(index)
    total = fields["reward"][index, lane]
    of_members = (...,) + (None,) * (total.ndim - index.ndim)  # a world ends for all members of a team
    for step in range(1, horizon.steps):
        place = (index + step) % places
        total = total + going[of_members] * horizon.gamma**step * fields["reward"][place, lane]
        last = torch.where(going, place, last)
        steps = steps + going
        going = going & goes_on(place)
    return last, total.unsqueeze(-1), steps
