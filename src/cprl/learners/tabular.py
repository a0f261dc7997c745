"""TabularLearner: Q-learning with tables of action values, for boards small enough to tabulate.

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
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor, nn

from cprl import keys
from cprl.commons.spaces import Spaces
from cprl.keys import Turn
from cprl.learners.lanes import Lanes
from cprl.learners.settings import TabularSettings
from cprl.objectives.rewards import RewardModel
from cprl.policies.actors import LaneActor
from cprl.policies.rng import Purpose
from cprl.policies.tabular import NEVER_MET, QTables, TableNetwork, states_of


class TabularLearner:
    """The learner of S tabular agents of each of R replicas, each with its own table.

    A `cprl.learners.protocol.AnyLearner`; its tables are in the CPU's memory.

    Args:
        lanes: the agents that learn. Its `start_from` has the tables with which agents start, whose values
            count as never updated.
        settings: the hyperparameters.

    Raises:
        MemoryError: from `store`, if an agent visits more than `settings.max_states` states.
    """

    def __init__(self, lanes: Lanes, settings: TabularSettings) -> None:
        self.lanes = lanes
        self.settings = settings
        self.spaces = lanes.spaces
        self.agents = lanes.agents
        self.replicas = lanes.replicas
        self.worlds = lanes.worlds
        self.rewards = RewardModel(lanes.reward)
        self.steps = 0
        self.tables = QTables(len(lanes), lanes.spaces.actions, max_states=settings.max_states)
        for lane, name in enumerate(lanes.names):
            if name in lanes.start_from:
                start = lanes.start_from[name]
                self.tables.add_lane(lane, start["states"].numpy(), start["values"].numpy())
        self.actor = self._actor(Purpose.EXPLORATION, worlds=self.worlds)
        self.actor.epsilon = settings.epsilon(0)
        self._form = lanes.form()
        self._columns = lanes.columns.T.numpy()
        """The columns of a `LaneTurn` that hold the lanes of each world of the replicas, int64 [W, L]."""
        lane_by_column = np.empty(self._columns.size, np.int64)
        lane_by_column[self._columns] = np.arange(len(lanes))
        self._lane_by_column: list[int] = lane_by_column.tolist()
        """The lane of each column of a `LaneTurn`."""
        self._turns: deque[dict[str, NDArray[Any]]] = deque()
        """The turns that are stored and not yet learned from, oldest first."""

    def __repr__(self) -> str:
        return f"{type(self).__name__}(agents={self.agents}, replicas={self.replicas})"

    def begin(self) -> None:
        """Do nothing: stored turns do not refer to the turns after them."""

    def end_episode(self, ended: Tensor) -> None:
        """Do nothing: there are no targets."""

    def _actor(self, purpose: Purpose, *, worlds: int) -> LaneActor:
        """Return an actor of all agents, with random numbers for one purpose."""
        seeds = self.lanes.seeds(purpose)
        actions = self.spaces.actions
        return LaneActor(self.tables.outputs, actions, seeds=seeds, agents=len(self.agents), worlds=worlds)

    def evaluation_actor(self, worlds: int) -> LaneActor:
        """Return an actor with the current tables and the exploration of evaluations."""
        actor = self._actor(Purpose.EVALUATION, worlds=worlds)
        actor.epsilon = self.settings.epsilon_evaluation
        return actor

    def store(self, batch: TensorDictBase | Turn) -> None:
        """Store one turn of every world until `update` learns from it."""
        turn = Turn.of(batch)
        if isinstance(turn.next_world[keys.DONE], Tensor):  # on a GPU; tables are on the CPU
            turn = Turn.of(turn.batch.cpu())
        rewards = turn.next_agents["reward"][..., 0]
        shaped = self.rewards.add(rewards, turn.next_world[keys.DONE][..., 0])
        transitions = self.lanes.turn(turn, shaped, self._form)
        rows = self.tables.find_or_add(states_of(transitions.observation), self._lane_by_column)
        next_states = states_of(transitions.next_observation)
        next_rows = np.full(len(rows), NEVER_MET, np.int64)  # terminal states have the value 0
        continuing = np.flatnonzero(~transitions.terminated)
        next_rows[continuing] = self.tables.find_or_add(
            [next_states[column] for column in continuing],
            [self._lane_by_column[column] for column in continuing],
        )
        reward = transitions.reward.astype(np.float64)
        action = transitions.action.copy()
        self._turns.append({"row": rows, "action": action, "reward": reward, "next_row": next_rows})
        self.steps += self.worlds
        self.actor.epsilon = self.settings.epsilon(self.steps)

    def update(self) -> Tensor | None:
        """Learn from the oldest stored turn, one world after the other; return the mean squared errors,
        [R, S], or None if no turn is stored."""
        if not self._turns:
            return None
        turn = self._turns.popleft()
        values = self.tables.values
        errors = []
        for columns in self._columns:
            index = turn["row"][columns], turn["action"][columns]
            self.tables.visits[index] += 1  # no two lanes share a row, so each value is counted once
            target = turn["reward"][columns] + self.settings.gamma * values[turn["next_row"][columns]].max(1)
            errors.append(target - values[index])
            values[index] += self.settings.rates(self.tables.visits[index]) * errors[-1]
        squares = np.square(errors).mean(0)
        return torch.from_numpy(squares).view(self.replicas, len(self.agents))

    def finite(self) -> Tensor:
        """Return for each agent whether all values of its table are finite, bool [R, S]."""
        are_finite = np.ones(len(self.lanes), np.bool_)
        if not np.isfinite(self.tables.values[: self.tables.size].sum()):
            for lane in range(len(self.lanes)):
                are_finite[lane] = np.isfinite(self.tables.lane_table(lane)[1]).all()
        return torch.from_numpy(are_finite).view(self.replicas, len(self.agents))

    def values(self, batch: TensorDictBase | Turn) -> Tensor:
        """Return the highest action value of each agent after a turn, [B, S]."""
        next_observation = Turn.of(batch).batch["next", *keys.OBSERVATION]
        by_column = next_observation[:, list(self.agents)].flatten(0, 1).numpy(force=True)
        rows = self.tables.find(states_of(by_column), self._lane_by_column)
        return torch.from_numpy(self.tables.values[rows].max(1)).view(-1, len(self.agents))

    def networks(self) -> dict[str, nn.Module]:
        """Return copies of the agents' tables as networks, by name: "replica_0/agent_0" and so on."""
        networks: dict[str, nn.Module] = {}
        for name, table in self._network_states().items():
            networks[name] = table_network(self.spaces)
            networks[name].load_state_dict(table)
        return networks

    def _network_states(self) -> dict[str, dict[str, Tensor]]:
        """Return the state dicts of the agents' `TableNetwork`s, by name."""
        network_states = {}
        for lane, name in enumerate(self.lanes.names):
            states, values, _ = self.tables.lane_table(lane)
            network_states[name] = {"states": torch.from_numpy(states), "values": torch.from_numpy(values)}
        return network_states

    def state_dict(self) -> dict[str, Any]:
        """Return the full state of all lanes.

        "networks" repeats "tables" in the form in which `cprl.load` reads them.
        """
        turns = []
        for turn in self._turns:
            turns.append({name: torch.from_numpy(array) for name, array in turn.items()})
        return {
            "tables": self.tables.state_dict(),
            "networks": self._network_states(),
            "exploration": self.actor.rng.state_dict(),
            "steps": self.steps,
            "turns": turns,
            "rewards": self.rewards.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.tables.load_state_dict(state["tables"])
        self.actor.rng.load_state_dict(state["exploration"])
        self.steps = int(state["steps"])
        self.actor.epsilon = self.settings.epsilon(self.steps)
        self._turns.clear()
        for turn in state["turns"]:
            self._turns.append({name: field.numpy().copy() for name, field in turn.items()})

        self.rewards.load_state_dict(state["rewards"])


def table_network(spaces: Spaces) -> TableNetwork:
    """Return a network for an agent's table, which is still empty."""
    return TableNetwork(spaces.observation_shape, spaces.actions, observation_dtype=spaces.observation_dtype)
