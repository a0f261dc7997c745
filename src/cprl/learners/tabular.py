"""Tabular Q-learning, algorithm 1 of the study, for boards small enough to tabulate.

Source: M. Wiatrak, "Governing the Commons with Multi-Agent Reinforcement Learning" (2019), after Watkins and
Dayan, "Q-learning" (1992). With reward r of action a in state s, and next state s':

    target = r where s' is terminal, else r + gamma max over a' of Q(s', a')
    Q(s, a) <- (1 - alpha) Q(s, a) + alpha target

An episode that is truncated at its time limit has no terminal state: its last state bootstraps like any
other. A state is the agent's observation. The values are exact only if the observation is a Markov state. A
window that does not show every apple is none, as on most boards (`tests/test_tabular.py` shows when it is).
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
from cprl.learners.transitions import lane_turn
from cprl.objectives.rewards import RewardModel
from cprl.policies.lanes import LaneActor
from cprl.policies.rng import Purpose
from cprl.policies.tabular import NEVER_MET, QTables, TableNetwork, states_of


class TabularLearner:
    """R x S independent tabular agents: S agents of each of R replicas, each with its own table.

    A `cprl.learners.base.AnyLearner`; its tables are in the CPU's memory.

    Args:
        lanes: who learns, with the tables with which agents start in `start_from`; each value counts as never
            updated.

    Raises:
        MemoryError: from `store`, if an agent visits more than `settings.max_states` states.
    """

    def __init__(self, lanes: Lanes, settings: TabularSettings) -> None:
        self.lanes, self.settings, self.spaces = lanes, settings, lanes.spaces
        self.agents, self.replicas, self.worlds = lanes.agents, lanes.replicas, lanes.worlds
        self.rewards, self.steps = RewardModel(lanes.reward), 0
        self.tables = QTables(len(lanes), lanes.spaces.actions, max_states=settings.max_states)
        for lane, name in enumerate(lanes.names):
            if name in lanes.start_from:
                start = lanes.start_from[name]
                self.tables.add_lane(lane, start["states"].numpy(), start["values"].numpy())
        self.actor = self._actor(Purpose.EXPLORATION, worlds=self.worlds)
        self.actor.epsilon = settings.epsilon(0)
        self._columns = lanes.columns.T.numpy()
        """Where the lanes stand in a turn, of one world after the other, int64 [W, L]."""
        lane_of = np.empty(self._columns.size, np.int64)
        lane_of[self._columns] = np.arange(len(lanes))
        self._lane_of: list[int] = lane_of.tolist()
        """The lane of each place in a turn."""
        self._turns: deque[dict[str, NDArray[Any]]] = deque()

    def __repr__(self) -> str:
        return f"{type(self).__name__}(agents={self.agents}, replicas={self.replicas})"

    def begin(self) -> None:
        """Does nothing: a queued turn knows nothing of those after it."""

    def end_episode(self, ended: Tensor) -> None:
        """Does nothing: there are no targets."""

    def _actor(self, purpose: Purpose, *, worlds: int) -> LaneActor:
        seeds = self.lanes.seeds(purpose)
        actions = self.spaces.actions
        return LaneActor(self.tables.outputs, actions, seeds=seeds, agents=len(self.agents), worlds=worlds)

    def evaluation_actor(self, worlds: int) -> LaneActor:
        actor = self._actor(Purpose.EVALUATION, worlds=worlds)
        actor.epsilon = self.settings.epsilon_evaluation
        return actor

    def store(self, batch: TensorDictBase | Turn) -> None:
        """Queues one turn of every world for `update`."""
        whole = Turn.of(batch)
        if isinstance(whole.next_world[keys.DONE], Tensor):  # on a GPU; tables are on the CPU
            whole = Turn.of(whole.batch.cpu())
        rewards, done = whole.next_agents["reward"], whole.next_world[keys.DONE]
        turn = lane_turn(self.agents, whole, self.rewards.add(rewards[..., 0], done[..., 0]))
        rows = self.tables.find_or_add(states_of(turn.observation), self._lane_of)
        on = np.flatnonzero(~turn.terminated)
        next_seen = states_of(turn.next_observation)
        next_rows = np.full(len(rows), NEVER_MET, np.int64)
        next_states, lanes = [next_seen[column] for column in on], [self._lane_of[column] for column in on]
        next_rows[on] = self.tables.find_or_add(next_states, lanes)
        reward, action = turn.reward.astype(np.float64), turn.action.copy()
        self._turns.append({"row": rows, "action": action, "reward": reward, "next_row": next_rows})
        self.steps += self.worlds
        self.actor.epsilon = self.settings.epsilon(self.steps)

    def update(self) -> Tensor | None:
        """Learns from the oldest queued turn, of one world after the other; returns the mean squared errors
        [R, S], or None if there is none."""
        if not self._turns:
            return None
        turn, values = self._turns.popleft(), self.tables.values
        errors = []
        for columns in self._columns:
            place = turn["row"][columns], turn["action"][columns]
            self.tables.visits[place] += 1  # no two lanes share a row
            target = turn["reward"][columns] + self.settings.gamma * values[turn["next_row"][columns]].max(1)
            errors.append(target - values[place])
            values[place] += self.settings.rates(self.tables.visits[place]) * errors[-1]
        squares = np.square(errors).mean(0)
        return torch.from_numpy(squares).view(self.replicas, len(self.agents))

    def finite(self) -> Tensor:
        sound = np.ones(len(self.lanes), np.bool_)
        if not np.isfinite(self.tables.values[: self.tables.size].sum()):
            sound = np.array(
                [np.isfinite(self.tables.of_lane(lane)[1]).all() for lane in range(len(self.lanes))]
            )
        return torch.from_numpy(sound).view(self.replicas, len(self.agents))

    def values(self, batch: TensorDictBase | Turn) -> Tensor:
        """The highest action value of each agent at the end of a turn, [B, S]."""
        after = Turn.of(batch).batch["next", *keys.OBSERVATION]
        seen = after[:, list(self.agents)].flatten(0, 1).numpy(force=True)
        rows = self.tables.find(states_of(seen), self._lane_of)
        return torch.from_numpy(self.tables.values[rows].max(1)).view(-1, len(self.agents))

    def networks(self) -> dict[str, nn.Module]:
        made: dict[str, nn.Module] = {}
        for name, table in self._network_states().items():
            made[name] = table_network(self.spaces)
            made[name].load_state_dict(table)
        return made

    def _network_states(self) -> dict[str, dict[str, Tensor]]:
        states = {}
        for lane, name in enumerate(self.lanes.names):
            seen, values, _ = self.tables.of_lane(lane)
            states[name] = {"states": torch.from_numpy(seen), "values": torch.from_numpy(values)}
        return states

    def state_dict(self) -> dict[str, Any]:
        """The full state of all lanes, of which "networks" repeats "tables" as `cprl.load` reads them."""
        turns = [{name: torch.from_numpy(array) for name, array in turn.items()} for turn in self._turns]
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
        self._turns = deque(
            {name: field.numpy().copy() for name, field in turn.items()} for turn in state["turns"]
        )
        self.rewards.load_state_dict(state["rewards"])


def table_network(spaces: Spaces) -> TableNetwork:
    """Return the network that holds an agent's table, still empty."""
    return TableNetwork(spaces.observation_shape, spaces.actions, observation_dtype=spaces.observation_dtype)
