"""Transitions of single agents: those of lanes, and under TorchRL's default keys, which its losses read."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from cprl import keys
from cprl.keys import Turn


class Horizon(NamedTuple):
    """Returns of several steps: how many rewards they sum, and by which discount."""

    steps: int
    gamma: float


@dataclass(frozen=True, kw_only=True)
class TransitionForm:
    """What a lane stores of a turn, and what is sampled of it."""

    observation_shape: tuple[int, ...]
    """(C, X, Y); (S, C, X, Y) if a lane is a team of S agents."""
    observation_dtype: str = "uint8"
    action_shape: tuple[int, ...] = ()
    """Of a lane's action: () for one agent, (S,) for a team."""
    reward_shape: tuple[int, ...] = ()
    """Of a lane's reward: (S,) for a team whose members have their own, else ()."""
    noise_shape: tuple[int, ...] = ()
    """Of the uniform numbers that the loss reads with each transition: the entry "noise", float32
    [L, b, *noise_shape]; () for none."""
    horizon: Horizon | None = None
    """Steps and discount of n-step returns, sampled in place of rewards; None for single steps."""
    state_cells: int = 0
    """The numbers K of the state of a lane's recurrent network; 0 for one without."""
    sequence_steps: int = 1
    """Turns of sampled sequences; 1 for transitions."""
    has_in_play: bool = False
    """Whether it is stored who is in play."""

    @property
    def dtype(self) -> torch.dtype:
        dtype: torch.dtype = getattr(torch, self.observation_dtype)
        return dtype

    @property
    def steps_ahead(self) -> int:
        """The turns after its first one that a sample reads."""
        return (self.horizon.steps if self.horizon else self.sequence_steps) - 1


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
    in_play: Any = None
    """bool [C], of teams [C, S]: whether it was in play, of lanes that learn from such turns alone."""


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


def transitions_of(fields: Mapping[str, Any]) -> TensorDict:
    """The fields of a `LaneTurn`, of any batch size, as transitions under TorchRL's default keys."""
    named = {name: torch.as_tensor(field) for name, field in fields.items() if field is not None}
    size = named["done"].shape
    following = {name: named[name].unsqueeze(-1) for name in ("reward", "done", "terminated")}
    following["observation"] = named["next_observation"]
    now = {name: named[name] for name in ("observation", "action")}
    return TensorDict({**now, "next": TensorDict(following, size)}, size)


def refuse_other_dtype(dtype: Any, allowed: Any) -> None:
    """Raises a ValueError for observations of another dtype than learners store; they would be rounded."""
    if dtype != allowed:
        raise ValueError(
            f"observations are {dtype}; allowed: {allowed}, from Spaces.observation_dtype: make the learner "
            "with the Spaces of the transformed environment"
        )


def made_up(batch: TensorDict, actions: int) -> TensorDict:
    """A batch in the form of another one, of other observations, actions and numbers; always the same."""
    rng = torch.Generator().manual_seed(0)

    def other(name: Any, entry: Tensor) -> Tensor:
        if entry.is_floating_point():
            return torch.rand(entry.shape, generator=rng).to(entry)
        if name == "action" or entry.dtype == torch.uint8:
            highest = actions if name == "action" else 256
            return torch.randint(highest, entry.shape, generator=rng).to(entry)
        return entry

    made: TensorDict = batch.named_apply(other, nested_keys=True)
    return made
