"""Transitions of single agents: a turn as the lanes store it, and as TorchRL's losses read it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import torch
from tensordict import TensorDict
from torch import Tensor

from cprl.keys import Turn

Sizes: TypeAlias = dict[str, tuple[tuple[int, ...], torch.dtype]]
"""The shape and the dtype of fields, by name."""


class Horizon(NamedTuple):
    """The number of rewards that n-step returns sum, and their discount."""

    steps: int
    gamma: float


@dataclass(frozen=True, kw_only=True)
class TransitionForm:
    """The shapes and dtypes of what a lane stores of a turn, and of what is sampled."""

    observation_shape: tuple[int, ...]
    """The shape of a lane's observation: (C, X, Y), or (S, C, X, Y) for a team of S agents."""
    observation_dtype: str = "uint8"
    """The dtype of observations, by its name in torch."""
    action_shape: tuple[int, ...] = ()
    """The shape of a lane's action: () for one agent; (S,) for a team; (N,) if it includes the actions of all
    agents of the game."""
    reward_shape: tuple[int, ...] = ()
    """The shape of a lane's reward: (S,) for a team whose members have their own rewards, else ()."""
    noise_shape: tuple[int, ...] = ()
    """The shape of the uniform numbers that the loss reads with each transition, the entry "noise", float32
    [L, b, *noise_shape]; () if the loss reads none."""
    horizon: Horizon | None = None
    """The steps and the discount of the returns that are sampled in place of rewards; None for rewards."""
    state_cells: int = 0
    """The numbers K in the state of a lane's recurrent network; 0 for a network without a state."""
    sequence_steps: int = 1
    """The turns of each sampled sequence; 1 if single transitions are sampled."""
    has_in_play: bool = False
    """True if the memory stores which agents are in play."""

    @property
    def fields(self) -> Sizes:
        """Return the shape and the dtype of each field of one lane's `LaneTurn`, without recurrent states."""
        observation = self.observation_shape, getattr(torch, self.observation_dtype)
        fields: Sizes = {
            "observation": observation,
            "action": (self.action_shape, torch.int64),
            "next_observation": observation,
            "reward": (self.reward_shape, torch.float32),
            "done": ((), torch.bool),
            "terminated": ((), torch.bool),
        }
        if self.has_in_play:
            fields["in_play"] = self.action_shape, torch.bool
        return fields

    @property
    def steps_ahead(self) -> int:
        """Return how many turns a sample reads after its first turn."""
        return (self.horizon.steps if self.horizon else self.sequence_steps) - 1


class LaneTurn(NamedTuple):
    """One turn as transitions of L lanes in W worlds each, C = L x W columns.

    Columns are in the order of the worlds, see `Lanes.by_lane`. Fields are numpy arrays on the CPU, else
    tensors. If lanes are teams of S agents, fields of agents have a second axis for members, [C, S, ...].
    """

    observation: Any
    """[C, *observation_shape], before the turn."""
    action: Any
    """int64 [C], or [C, N] for lanes that store the actions of all agents, see `joint_actions_by_agent`."""
    next_observation: Any
    """[C, *observation_shape], after the turn."""
    reward: Any
    """float32 [C]; for teams [C, S], or [C] if the members share their reward."""
    done: Any
    """bool [C]."""
    terminated: Any
    """bool [C]."""
    recurrent_state: Any = None
    """float32 [C, K], the states before the turn; None for lanes without a recurrent network."""
    next_recurrent_state: Any = None
    """float32 [C, K], the states after the turn; None for lanes without a recurrent network."""
    in_play: Any = None
    """bool [C], or [C, S] for teams: whether agents are in play; None for lanes that learn from all turns."""


def joint_actions_by_agent(agents: Sequence[int], turn: Turn) -> Any:
    """Return the actions of all N agents in one turn, as each of S agents of every world stores them.

    Returns:
        int64 [B x S, N]: first an agent's own action, then the others' in the order of their indices. An
        agent that is out of play has the action that it chose, though it has no effect.
    """
    actions = turn.agents["action"]
    game_agents = actions.shape[1]
    order = []
    for agent in agents:
        order.append([agent, *(peer for peer in range(game_agents) if peer != agent)])
    return actions[:, order].reshape(len(actions) * len(agents), game_agents)


def array_of(tensor: Tensor) -> Any:
    """Return a tensor on the CPU as a numpy view, and a tensor on a GPU as it is; both are indexed alike."""
    return tensor.numpy() if tensor.is_cpu else tensor


def transitions_of(fields: Mapping[str, Any]) -> TensorDict:
    """Return the fields of a `LaneTurn`, of any batch size, as transitions under TorchRL's default keys."""
    tensors = {name: torch.as_tensor(field) for name, field in fields.items() if field is not None}
    size = tensors["done"].shape
    next_entries = {name: tensors[name].unsqueeze(-1) for name in ("reward", "done", "terminated")}
    next_entries["observation"] = tensors["next_observation"]
    entries = {name: tensors[name] for name in ("observation", "action")}
    return TensorDict({**entries, "next": TensorDict(next_entries, size)}, size)


def refuse_other_dtype(dtype: Any, allowed: Any) -> None:
    """Raise a ValueError if observations have another dtype than learners store: they would be rounded."""
    if dtype != allowed:
        raise ValueError(
            f"observations are {dtype}; allowed: {allowed}, from Spaces.observation_dtype: make the learner "
            "with the Spaces of the transformed environment"
        )


def randomized(batch: TensorDict, actions: int) -> TensorDict:
    """Return a synthetic batch: random observations, actions and other numbers in the shapes of a batch.

    The numbers are the same in every call.

    Args:
        actions: the number of actions A.
    """
    rng = torch.Generator().manual_seed(0)

    def random(name: Any, entry: Tensor) -> Tensor:
        if entry.is_floating_point():
            return torch.rand(entry.shape, generator=rng).to(entry)
        if name == "action" or entry.dtype == torch.uint8:
            highest = actions if name == "action" else 256
            return torch.randint(highest, entry.shape, generator=rng).to(entry)
        return entry

    return batch.named_apply(random, nested_keys=True)
