"""Acting by tables: the value of each action in each state that an agent has met, and who reads it."""

from collections.abc import Mapping, Sequence
from math import prod
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type

from cprl.commons.game import Game
from cprl.policies.rng import LaneRng

NEVER_MET = 0
"""The row of a state that is in no table; its values stay 0."""
_FIRST_ROWS = 1024


class QTables:
    """A table for each lane, all in one array; a state is the bytes of what its agent observes.

    Args:
        lanes: how many tables L.
        actions: how many actions A a row has.
        max_states: rows of a lane at most.
    """

    def __init__(self, lanes: int, actions: int, *, max_states: int) -> None:
        self.max_states = max_states
        self.rows: list[dict[bytes, int]] = [{} for _ in range(lanes)]
        """Of each lane, the row of each state that it has met."""
        self.values = np.zeros((_FIRST_ROWS, actions), np.float64)
        """float64 [rows, A], rows of all lanes as they were met; row 0 is of states never met."""
        self.visits = np.zeros((_FIRST_ROWS, actions), np.int64)
        """int64 [rows, A]: how often each value was learned."""
        self.size = 1

    def find(self, states: Sequence[bytes], lanes: Sequence[int]) -> NDArray[np.int64]:
        """The row of each state in the table of its lane, int64 [n]; NEVER_MET where there is none."""
        found = [self.rows[lane].get(state, NEVER_MET) for state, lane in zip(states, lanes, strict=True)]
        return np.array(found, np.int64)

    def find_or_add(self, states: Sequence[bytes], lanes: Sequence[int]) -> NDArray[np.int64]:
        """The same, with a new row for a state never met.

        Raises:
            MemoryError: where a lane would have more than `max_states`.
        """
        rows = self.find(states, lanes)
        for n in np.flatnonzero(rows == NEVER_MET).tolist():
            rows[n] = self._add(states[n], lanes[n])
        return rows

    def _add(self, state: bytes, lane: int) -> int:
        own = self.rows[lane]
        if len(own) >= self.max_states:
            raise MemoryError(
                f"lane {lane} has met {len(own):,} states, as many as max_states allows, and now another; "
                "tabulate a smaller board, see less of it, or raise TabularSettings.max_states"
            )
        if self.size == len(self.values):
            self.values = np.concatenate([self.values, np.zeros_like(self.values)])
            self.visits = np.concatenate([self.visits, np.zeros_like(self.visits)])
        own[state], self.size = self.size, self.size + 1
        return own[state]

    def of_lane(self, lane: int) -> tuple[NDArray[np.uint8], NDArray[np.float64], NDArray[np.int64]]:
        """The states that a lane has met, uint8 [n, bytes], their values and visits [n, A]; copies."""
        states, rows = list(self.rows[lane]), list(self.rows[lane].values())
        flat = np.frombuffer(b"".join(states), np.uint8).reshape(len(states), -1 if states else 0)
        return flat.copy(), self.values[rows], self.visits[rows]

    def state_dict(self) -> dict[str, Tensor]:
        """All tables as tensors, a row for each state in the order in which they were met."""
        known = sorted((row, lane, state) for lane, own in enumerate(self.rows) for state, row in own.items())
        states = np.frombuffer(b"".join(state for _, _, state in known), np.uint8).copy()
        return {
            "states": torch.from_numpy(states.reshape(len(known), -1) if known else states.reshape(0, 0)),
            "lanes": torch.tensor([lane for _, lane, _ in known], dtype=torch.int64),
            "values": torch.from_numpy(self.values[: self.size].copy()),
            "visits": torch.from_numpy(self.visits[: self.size].copy()),
        }

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Goes on with the tables of that state."""
        self.rows = [{} for _ in self.rows]
        for row, (seen, lane) in enumerate(
            zip(state["states"].numpy(), state["lanes"].tolist(), strict=True)
        ):
            self.rows[lane][seen.tobytes()] = row + 1
        self.values, self.visits = (state[name].numpy().copy() for name in ("values", "visits"))
        self.size = len(self.values)


def observed_entries(game: Game) -> tuple[str, ...]:
    """The names of all that agents of a game observe."""
    gauge = ("stock_gauge",) if game.observation.stock_gauge else ()
    board = ("scoreboard",) if game.observation.scoreboard else ()
    return ("observation", *gauge, *board)


def states_of(
    observed: TensorDictBase, names: Sequence[str], agents: Sequence[int] | None = None
) -> list[bytes]:
    """The state of each agent: the bytes of all that it observes.

    Args:
        observed: the entries of `observed_entries`, [B, S, ...] each.
        names: which entries.
        agents: the agents' numbers; None for all.

    Returns:
        B x S states, world by world.
    """
    arrays = [observed.get(name).numpy(force=True) for name in names]
    if agents is not None:
        arrays = [array[:, list(agents)] for array in arrays]
    count = arrays[0].shape[0] * arrays[0].shape[1]
    flat = [np.ascontiguousarray(array).reshape(count, -1).view(np.uint8) for array in arrays]
    return [state.tobytes() for state in (flat[0] if len(flat) == 1 else np.concatenate(flat, 1))]


class TableNetwork(nn.Module):
    """What one agent has tabulated as an acting network, to be kept, loaded and frozen like any other.

    Its state dict holds "states", uint8 [n, C X Y], and their "values", float64 [n, A]; it takes one with any
    number of states. At first it knows none.

    Args:
        observation_shape: (C, X, Y) of an observation.
        actions: how many actions A there are.
    """

    states: Tensor
    values: Tensor

    def __init__(self, observation_shape: Sequence[int], actions: int) -> None:
        super().__init__()
        self.observation_dims = len(observation_shape)
        self.register_buffer("states", torch.zeros((0, prod(observation_shape)), dtype=torch.uint8))
        self.register_buffer("values", torch.zeros((0, actions), dtype=torch.float64))
        self._rows: dict[bytes, int] = {}

    def forward(self, observation: Tensor) -> Tensor:
        """uint8 [..., C, X, Y] to float64 [..., A]; 0 for what was never met."""
        seen = observation.flatten(-self.observation_dims)
        flat = seen.reshape(-1, seen.shape[-1]).numpy(force=True)
        rows = torch.tensor([self._rows.get(state.tobytes(), -1) for state in flat])
        values, known = self.values.new_zeros((len(rows), self.values.shape[1])), rows >= 0
        values[known] = self.values[rows[known]]
        return values.reshape(*seen.shape[:-1], -1)

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *how: Any) -> None:
        """As torch's, with as many states as come."""
        for name in ("states", "values"):
            own, came = getattr(self, name), state_dict.get(prefix + name)
            if came is not None and came.shape[1:] == own.shape[1:]:
                setattr(self, name, own.new_zeros(came.shape))
        super()._load_from_state_dict(state_dict, prefix, *how)
        self._rows = {state.tobytes(): row for row, state in enumerate(self.states.numpy(force=True))}


class TabularActor(TensorDictModuleBase):
    """Chooses by the tables of its lanes: greedily, or with chance `epsilon` at random.

    It explores under `ExplorationType.RANDOM` alone, by random numbers of each lane's own. Of equal values
    the first action's wins, so in a state never met it is the first action.

    Args:
        tables: of the lanes, lane = replica x seats + seat.
        game: what is played.
        seeds: of each lane's exploration.
        agents: how many seats S of a replica it takes.
        worlds: how many worlds k of each replica are played at once, side by side in the batch.

    Reads "observation", [replicas x k, S, C, X, Y], and what else the game tells agents, "stock_gauge" and
    "scoreboard"; writes "action", int64 [replicas x k, S].
    """

    out_keys = ("action",)
    stochastic = False

    def __init__(
        self, tables: QTables, game: Game, *, seeds: Sequence[Sequence[int]], agents: int, worlds: int = 1
    ) -> None:
        super().__init__()
        self.in_keys = observed_entries(game)
        self.tables, self.actions, self.epsilon = tables, len(game.actions), 1.0
        self.agents, self.worlds, self.replicas = agents, worlds, len(seeds) // agents
        self.rng = LaneRng(seeds, 2 * worlds)
        lanes = np.arange(len(seeds)).reshape(self.replicas, 1, agents)
        self._lanes = np.broadcast_to(lanes, (self.replicas, worlds, agents)).reshape(-1).tolist()

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """See the class."""
        rows = self.tables.find(states_of(tensordict, self.in_keys), self._lanes)
        chosen = self.tables.values[rows].argmax(1)
        if exploration_type() in (ExplorationType.RANDOM, None):
            drawn = self.rng.next().numpy().reshape(self.replicas, self.agents, self.worlds, 2)
            explores, which = drawn.transpose(3, 0, 2, 1).reshape(2, -1)
            chosen = np.where(explores < self.epsilon, (which * self.actions).astype(np.int64), chosen)
        action = torch.from_numpy(chosen.reshape(-1, self.agents)).to(tensordict.get("observation").device)
        return tensordict.set("action", action)

    def get_extra_state(self) -> dict[str, Any]:
        """Where its random numbers stand; part of `state_dict`."""
        return self.rng.state_dict()

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """See `get_extra_state`."""
        self.rng.load_state_dict(state)
