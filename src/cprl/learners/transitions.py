"""Transitions of single agents: those of lanes, and under TorchRL's default keys, which its losses read."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from cprl import keys
from cprl.keys import Turn


class LaneTurn(NamedTuple):
    """One transition of each of L lanes in each of its W worlds, C = L x W columns in the order of the
    worlds, see `by_lane`; numpy arrays on the CPU, else tensors. Where lanes are teams of S agents, their
    fields have the axis of members next: [C, S, ...]."""

    observation: Any
    """[C, *shape] of observations."""
    action: Any
    """int64 [C], or [C, N] for lanes that see the actions of their peers, see `joint_actions`."""
    next_observation: Any
    """[C, *shape]."""
    reward: Any
    """float32 [C]; of teams [C, S] or, if their members share it, [C]."""
    done: Any
    """bool [C]."""
    terminated: Any
    """bool [C]."""
    recurrent_state: Any = None
    """float32 [C, K], before the turn, of lanes with a recurrent network."""
    next_recurrent_state: Any = None
    """After it, likewise."""


def lane_turn(agents: Sequence[int], turn: Turn, rewards: Any, *, are_team: bool = False) -> LaneTurn:
    """One transition of each of S agents in every world, column = world x S + position in `agents`; views
    where that is possible.

    Args:
        rewards: those that all agents want, [B, N].
        are_team: whether the agents of a world are one column.
    """
    worlds, everyone = rewards.shape
    at = list(agents)
    everyone_learns = at == list(range(everyone))
    columns = (worlds, len(at)) if are_team else (worlds * len(at),)

    def of(array: Any) -> Any:
        return (array if everyone_learns else array[:, at]).reshape(*columns, *array.shape[2:])

    def of_world(flags: Any) -> Any:
        if are_team:
            return flags.reshape(worlds)
        return flags.repeat(len(at)) if isinstance(flags, np.ndarray) else flags.repeat_interleave(len(at))

    return LaneTurn(
        of(turn.agents["observation"]),
        of(turn.agents["action"]),
        of(turn.next_agents["observation"]),
        of(rewards),
        of_world(turn.next_world[keys.DONE]),
        of_world(turn.next_world[keys.TERMINATED]),
    )


def joint_actions(agents: Sequence[int], turn: Turn) -> Any:
    """The actions of all N agents in one turn, as each of S agents of every world sees them.

    Returns:
        int64 [B x S, N]: first an agent's own action, then the others' in the order of their indices. They
        are those that agents chose, also where an agent was out of play and its action did not count.
    """
    actions = turn.agents["action"]
    everyone = actions.shape[1]
    order = [[agent, *(other for other in range(everyone) if other != agent)] for agent in agents]
    return actions[:, order].reshape(len(actions) * len(agents), everyone)


def by_lane(columns: Tensor, *, replicas: int, worlds: int) -> Tensor:
    """Values of all columns of a turn, [C, ...], as those of lanes and their worlds, [L, W, ...].

    Columns are in the order of the B = R x W worlds, and within a world in that of its lanes: the agents that
    learn apart, or one team.
    """
    if worlds == 1:
        return columns[:, None]
    by_world = columns.reshape(replicas, worlds, -1, *columns.shape[1:])
    return by_world.swapaxes(1, 2).reshape(-1, worlds, *columns.shape[1:])


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
    size, after = batch.batch_size, batch.get("next")
    flags = {name: after.get(name) for name in (keys.DONE, keys.TERMINATED, keys.TRUNCATED)}

    def of(owner: TensorDictBase, *names: str) -> dict[str, Tensor]:
        return {name: owner.get((keys.AGENTS, name)).select(len(size), agent) for name in names}

    following = TensorDict({**of(after, "observation", "reward"), **flags}, size)
    return TensorDict({**of(batch, "observation", "action"), "next": following}, size).reshape(-1)


def refuse_other_dtype(dtype: Any, allowed: Any) -> None:
    """Raises a ValueError for observations of another dtype than learners store; they would be rounded."""
    if dtype != allowed:
        raise ValueError(
            f"observations are {dtype}; allowed: {allowed}, from Spaces.observation_dtype: make the learner "
            "with the Spaces of the transformed environment"
        )
