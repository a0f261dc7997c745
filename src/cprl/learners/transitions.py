"""What one agent lived through, under TorchRL's default keys, so that any of its losses can read it."""

from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from cprl import keys

RewardKind: TypeAlias = Literal["own", "group"]
"""What a learner is paid each turn: its own reward, or the sum of all agents' rewards."""


class LaneTurn(NamedTuple):
    """One transition of each of L lanes, as tensors or numpy arrays."""

    observation: Any
    """uint8 [L, C, X, Y]."""
    action: Any
    """int64 [L]."""
    next_observation: Any
    """uint8 [L, C, X, Y]."""
    reward: Any
    """float32 [L]."""
    done: Any
    """bool [L]."""
    terminated: Any
    """bool [L]."""


def lane_turn(agents: tuple[int, ...], batch: TensorDictBase, *, reward_kind: RewardKind = "own") -> LaneTurn:
    """The transitions of the agents at some seats of every replica, a turn of each.

    Args:
        agents: the agents' numbers, S.
        batch: entries of `cprl.keys` at the root and under "next", of batch size [R].
        reward_kind: which reward they get.

    Returns:
        What `transitions_of` gives of each agent, lane = replica x S + seat; numpy views of what lies on the
        CPU, as far as possible: on so few numbers torch takes several times as long.
    """
    entry = keys.entry
    before, after = entry(batch, keys.AGENTS), entry(batch, "next")
    agents_after = entry(after, keys.AGENTS)
    observation = array_of(entry(before, "observation"))
    everyone = len(agents) == observation.shape[1]
    lanes, windows, at = len(observation) * len(agents), observation.shape[2:], list(agents)

    def of(tensor: Tensor, *shape: int) -> Any:
        array = array_of(tensor)
        return (array if everyone else array[:, at]).reshape(lanes, *shape)

    def of_world(flag: Tensor) -> Any:
        array = array_of(flag)
        repeat = array.repeat if isinstance(array, np.ndarray) else array.repeat_interleave
        return repeat(len(at))

    reward = entry(agents_after, "reward")
    return LaneTurn(
        of(entry(before, "observation"), *windows),
        of(entry(before, "action")),
        of(entry(agents_after, "observation"), *windows),
        of(reward) if reward_kind == "own" else of_world(reward.sum(1)),
        of_world(entry(after, keys.DONE)),
        of_world(entry(after, keys.TERMINATED)),
    )


def seen_next(batch: TensorDictBase) -> Tensor:
    """What all agents see at the end of a turn, uint8 [R, N, C, X, Y]."""
    seen: Tensor = keys.entry(keys.entry(keys.entry(batch, "next"), keys.AGENTS), "observation")
    return seen


def array_of(tensor: Tensor) -> Any:
    """The same memory as a numpy array; as it is where it lies on a GPU. Both are indexed alike."""
    return tensor.numpy() if tensor.is_cpu else tensor


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
