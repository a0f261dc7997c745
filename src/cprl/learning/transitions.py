"""What one agent lived through, under TorchRL's default keys, so that any of its losses can read it."""

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from cprl import keys


def lane_transitions(seats: tuple[int, ...], batch: TensorDictBase) -> TensorDict:
    """The transitions of the agents at some seats of every replica, a turn of each.

    Args:
        seats: the agents' numbers, S.
        batch: entries of `cprl.keys` at the root and under "next", of batch size [R] or [R, 1].

    Returns:
        Like `transitions_of`, but [R x S], lane = replica x S + seat.
    """
    replicas = batch.batch_size[0]
    lanes = replicas * len(seats)
    before, after = batch.get(keys.AGENTS), batch.get("next")
    agents_after = after.get(keys.AGENTS)
    at = list(seats)

    def of(entries: TensorDictBase, name: str) -> Tensor:
        entry = entries.get(name)
        entry = entry.reshape(replicas, *entry.shape[len(batch.batch_size) :])
        chosen: Tensor = entry if len(at) == entry.shape[1] else entry[:, at]
        return chosen.reshape(lanes, *entry.shape[2:])

    def of_world(name: str) -> Tensor:
        flag: Tensor = after.get(name).reshape(replicas, 1, 1)
        return flag.expand(replicas, len(at), 1).reshape(lanes, 1)

    new = TensorDict._new_unsafe
    following = new(
        {
            "observation": of(agents_after, "observation"),
            "reward": of(agents_after, "reward"),
            **{name: of_world(name) for name in (keys.DONE, keys.TERMINATED, keys.TRUNCATED)},
        },
        batch_size=torch.Size([lanes]),
    )
    entries = {"observation": of(before, "observation"), "action": of(before, "action"), "next": following}
    return new(entries, batch_size=torch.Size([lanes]))


def transitions_of(agent: int, batch: TensorDictBase) -> TensorDict:
    """The transitions of one agent out of what a collector yields.

    Args:
        agent: its number.
        batch: entries of `cprl.keys` at the root and under "next", of any batch size.

    Returns:
        A flat TensorDict [transitions] of "observation" uint8 [.., 3, X, Y], "action" int64 [..] and "next":
        "observation", "reward" float32 [.., 1], "done", "terminated", "truncated" bool [.., 1].
        Turns that the agent spends out of play are transitions too, with the action that it chose.
    """
    before, after = batch.get(keys.AGENTS), batch.get("next")
    agents_after = after.get(keys.AGENTS)
    dim = len(batch.batch_size)
    following = TensorDict(
        {
            "observation": agents_after.get("observation").select(dim, agent),
            "reward": agents_after.get("reward").select(dim, agent),
            **{name: after.get(name) for name in (keys.DONE, keys.TERMINATED, keys.TRUNCATED)},
        },
        batch_size=batch.batch_size,
    )
    return TensorDict(
        {
            "observation": before.get("observation").select(dim, agent),
            "action": before.get("action").select(dim, agent),
            "next": following,
        },
        batch_size=batch.batch_size,
    ).reshape(-1)
