"""The memory and the tables of agents that learn by Q-learning in tables, on boards small enough to tabulate.

This is algorithm 1 of the study.

Source: M. Wiatrak, "Governing the Commons with Multi-Agent Reinforcement Learning" (2019), after Watkins and
Dayan, "Q-learning" (1992). With reward r of action a in state s, and next state s':

    target = r where s' is terminal, else r + gamma max over a' of Q(s', a')
    Q(s, a) <- (1 - alpha) Q(s, a) + alpha target

The last state of an episode that ends at its time limit is not terminal: it bootstraps like any other. A
state is the agent's observation, so the values are exact only if the observation is a Markov state. On most
boards it is not, because the window does not show every apple (`tests/learners/test_tabular.py` shows when it
is).
"""

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cprl.commons.spaces import Spaces
from cprl.keys import Turn
from cprl.learners.lanes import Lanes
from cprl.learners.settings import TabularSettings
from cprl.learners.transitions import LaneTurn
from cprl.policies.tabular import NEVER_MET, QTables, TableNetwork, states_of

_Arrays = dict[str, NDArray[Any]]


class TabularMemory:
    """A memory of the turns that tables have not yet learned from.

    It finds the states of a turn in the tables when it stores the turn, and adds those that are new.

    Raises:
        MemoryError: from `write`, if an agent visits more than `settings.max_states` states.
    """

    def __init__(self, lanes: Lanes, settings: TabularSettings) -> None:
        self.lanes = lanes
        self.form = lanes.form()
        self.tables = QTables(len(lanes), lanes.spaces.actions, max_states=settings.max_states)
        columns = lanes.columns.numpy()
        lane_by_column = np.empty(columns.size, np.int64)
        lane_by_column[columns] = np.arange(len(lanes))[:, None]
        self._lane_by_column: list[int] = lane_by_column.tolist()
        """The lane of each column of a `LaneTurn`."""
        self._turns: deque[_Arrays] = deque()
        """The turns that are stored and not yet learned from, oldest first."""

    def write(self, turn: Turn, lane_turn: LaneTurn) -> None:
        """Store a turn; `cprl.learners.learner.Memory.write` says the arguments."""
        fields = {
            name: torch.as_tensor(field).numpy(force=True)  # tables are on the CPU
            for name, field in lane_turn._asdict().items()
            if field is not None
        }
        rows = self.tables.find_or_add(states_of(fields["observation"]), self._lane_by_column)
        next_states = states_of(fields["next_observation"])
        next_rows = np.full(len(rows), NEVER_MET, np.int64)  # terminal states have the value 0
        continuing = np.flatnonzero(~fields["terminated"])
        next_rows[continuing] = self.tables.find_or_add(
            [next_states[column] for column in continuing],
            [self._lane_by_column[column] for column in continuing],
        )
        reward = fields["reward"].astype(np.float64)
        action = fields["action"].copy()
        self._turns.append({"row": rows, "action": action, "reward": reward, "next_row": next_rows})

    def due(self, networks: "TabularNetworks") -> Iterator[_Arrays]:
        """Yield the oldest turn that is not yet learned from; none if there is none."""
        if self._turns:
            yield self._turns.popleft()

    def values(self, networks: "TabularNetworks", turn: Turn) -> Tensor:
        """Return the highest action value after a turn, [L, W]."""
        return networks.outputs(self.lanes.next_observations(turn)).amax(-1)

    def cut(self, networks: "TabularNetworks") -> None:
        """Do nothing: stored turns do not refer to the turns after them."""

    def state_dict(self) -> dict[str, Any]:
        turns = []
        for turn in self._turns:
            turns.append({name: torch.from_numpy(array) for name, array in turn.items()})
        return {"turns": turns}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self._turns.clear()
        for turn in state["turns"]:
            self._turns.append({name: array.numpy().copy() for name, array in turn.items()})


class TabularNetworks:
    """The tables of all lanes in place of their networks.

    Args:
        networks: the tables with which lanes start, whose values count as never updated.
        memory: their memory, which has the tables.
    """

    update = "list"

    def __init__(
        self, networks: Sequence[TableNetwork], memory: TabularMemory, settings: TabularSettings
    ) -> None:
        self.tables = memory.tables
        self.settings = settings
        self._columns = memory.lanes.columns.T.numpy()
        """The columns of a `LaneTurn` that hold the lanes of each world of the replicas, int64 [W, L]."""
        for lane, network in enumerate(networks):
            self.tables.add_lane(lane, network.states.numpy(force=True), network.values.numpy(force=True))

    def outputs(self, observation: Tensor) -> Tensor:
        """Return the action values of lanes, float64 [L, k, A]."""
        return self.tables.outputs(observation)

    def learn(self, turn: _Arrays) -> Tensor:
        """Learn from a turn, one world after the other; return the mean squared errors, [L]."""
        values = self.tables.values
        errors = []
        for columns in self._columns:
            index = turn["row"][columns], turn["action"][columns]
            self.tables.visits[index] += 1  # no two lanes share a row, so each value is counted once
            target = turn["reward"][columns] + self.settings.gamma * values[turn["next_row"][columns]].max(1)
            errors.append(target - values[index])
            values[index] += self.settings.rates(self.tables.visits[index]) * errors[-1]
        return torch.from_numpy(np.square(errors).mean(0))

    def network_state(self, lane: int) -> dict[str, Tensor]:
        """Return copies of the table of a lane, as the state dict of its `TableNetwork`."""
        states, values, _ = self.tables.lane_table(lane)
        return {"states": torch.from_numpy(states), "values": torch.from_numpy(values)}

    def finite(self) -> Tensor:
        """Return for each lane whether all values of its table are finite, bool [L]."""
        lanes = len(self.tables.rows)
        are_finite = np.ones(lanes, np.bool_)
        if not np.isfinite(self.tables.values[: self.tables.size].sum()):
            for lane in range(lanes):
                are_finite[lane] = np.isfinite(self.tables.lane_table(lane)[1]).all()
        return torch.from_numpy(are_finite)

    def state_dict(self) -> dict[str, Tensor]:
        return self.tables.state_dict()

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        self.tables.load_state_dict(state)


def table_network(spaces: Spaces) -> TableNetwork:
    """Return a network for an agent's table, which is still empty."""
    return TableNetwork(spaces.observation_shape, spaces.actions, observation_dtype=spaces.observation_dtype)
