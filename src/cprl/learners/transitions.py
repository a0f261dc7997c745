"""Transitions of single agents, under TorchRL's default keys, which its losses read."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from cprl import keys
from cprl.learners.preferences import WantedRewards


class LaneTurn(NamedTuple):
    """One transition of each of L lanes, as tensors or numpy arrays. Where lanes are teams of S agents, their
    fields have the axis of members next: [L, S, ...]."""

    observation: Any
    """uint8 [L, C, X, Y]."""
    action: Any
    """int64 [L], or [L, N] for lanes that see the actions of their peers, see `joint_actions`."""
    next_observation: Any
    """uint8 [L, C, X, Y]."""
    reward: Any
    """float32 [L]; of teams [L, S] or, if their members share it, [L]."""
    done: Any
    """bool [L]."""
    terminated: Any
    """bool [L]."""
    recurrent_state: Any = None
    """float32 [L, K], before the turn, of lanes with a recurrent network."""
    next_recurrent_state: Any = None
    """After it, likewise."""


def lane_turn(
    agents: Sequence[int], batch: TensorDictBase, rewards: Any = None, *, are_team: bool = False
) -> LaneTurn:
    """One transition of each of some agents of every replica.

    Args:
        batch: entries of `cprl.keys` at the root and under "next", with batch size [R].
        rewards: the rewards that all agents want, [R, N], see `wanted_in`; by default those of the batch.
        are_team: whether the agents of a replica are one lane.

    Returns:
        The transitions of `transitions_of`, with lane = replica x S + position in `agents`. On the CPU they
        are numpy arrays, views if possible: for so few numbers numpy is several times faster than torch.
    """
    entry = keys.entry
    before, after = entry(batch, keys.AGENTS), entry(batch, "next")
    agents_after = entry(after, keys.AGENTS)
    observation = array_of(entry(before, "observation"))
    replicas, everyone, *window = observation.shape
    at = list(agents)
    everyone_learns = at == list(range(everyone))
    lanes = (replicas, len(at)) if are_team else (replicas * len(at),)

    def of(array: Any, *shape: int) -> Any:
        return (array if everyone_learns else array[:, at]).reshape(*lanes, *shape)

    def of_world(flags: Any) -> Any:
        if are_team:
            return flags.reshape(replicas)
        return flags.repeat(len(at)) if isinstance(flags, np.ndarray) else flags.repeat_interleave(len(at))

    return LaneTurn(
        of(observation, *window),
        of(array_of(entry(before, "action"))),
        of(array_of(entry(agents_after, "observation")), *window),
        of(array_of(entry(agents_after, "reward")) if rewards is None else rewards),
        of_world(array_of(entry(after, keys.DONE))),
        of_world(array_of(entry(after, keys.TERMINATED))),
    )


def joint_actions(agents: Sequence[int], batch: TensorDictBase) -> Any:
    """The actions of all N agents in one turn, as each of some agents of every replica sees them.

    Returns:
        int64 [R x S, N]: first a lane's own action, then the others' in the order of their indices. They are
        those that agents chose, also where an agent was out of play and its action did not count.
    """
    actions = array_of(keys.entry(keys.entry(batch, keys.AGENTS), "action"))
    everyone = actions.shape[1]
    order = [[agent, *(other for other in range(everyone) if other != agent)] for agent in agents]
    return actions[:, order].reshape(len(actions) * len(agents), everyone)


def wanted_in(wants: WantedRewards, batch: TensorDictBase) -> Any:
    """The rewards that agents want in one turn of every replica; called once for each turn, in order.

    Returns:
        [R, N], a numpy array on the CPU, else a tensor.
    """
    after = keys.entry(batch, "next")
    rewards = keys.entry(keys.entry(after, keys.AGENTS), "reward")
    return wants.add(array_of(rewards)[..., 0], array_of(keys.entry(after, keys.DONE))[..., 0])


def seen_next(batch: TensorDictBase) -> Tensor:
    """The observations of all agents after a turn, uint8 [R, N, C, X, Y]."""
    seen: Tensor = keys.entry(keys.entry(keys.entry(batch, "next"), keys.AGENTS), "observation")
    return seen


def array_of(tensor: Tensor) -> Any:
    """A numpy view of a tensor on the CPU; a tensor on a GPU unchanged. Both are indexed alike."""
    return tensor.numpy() if tensor.is_cpu else tensor


def transitions_of(agent: int, batch: TensorDictBase) -> TensorDict:
    """The transitions of one agent from a collector's batch.

    Args:
        batch: entries of `cprl.keys` at the root and under "next", with any batch size.

    Returns:
        A flat TensorDict [transitions] of "observation" uint8 [.., 3, X, Y], "action" int64 [..] and "next":
        "observation", "reward" float32 [.., 1], "done", "terminated", "truncated" bool [.., 1].
        Turns that the agent spends out of play are included, with the action that it chose.
    """
    before, after, size = batch.get(keys.AGENTS), batch.get("next"), batch.batch_size
    now = {name: before.get(name).select(len(size), agent) for name in ("observation", "action")}
    following = {
        **{
            name: after.get((keys.AGENTS, name)).select(len(size), agent)
            for name in ("observation", "reward")
        },
        **{name: after.get(name) for name in (keys.DONE, keys.TERMINATED, keys.TRUNCATED)},
    }
    return TensorDict({**now, "next": TensorDict(following, size)}, size).reshape(-1)


def refuse_other_dtype(dtype: Any, allowed: Any) -> None:
    """Raises a ValueError for observations of another dtype than learners store; they would be rounded."""
    if dtype != allowed:
        raise ValueError(
            f"observations are {dtype}; allowed: {allowed}, from Spaces.observation_dtype: make the learner "
            "with the Spaces of the transformed environment"
        )
