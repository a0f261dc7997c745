"""Tabular Q-learning, algorithm 1 of the study, for boards small enough to tabulate.

Source: M. Wiatrak, "Governing the Commons with Multi-Agent Reinforcement Learning" (2019), after Watkins and
Dayan, "Q-learning" (1992). With r paid for action a in state s, which led to s':

    target = r where s' is terminal, else r + gamma max over a' of Q(s', a')
    Q(s, a) <- (1 - alpha) Q(s, a) + alpha target

An episode that the clock ends is not terminal: its last state counts as any other. A state is what the agent
observes. Values are those of the game only where that tells all that matters; an agent that looks away from
apples does not know which still hang, so windows on most boards do not (`tests/test_tabular.py` shows when).
"""

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor

from cprl import keys
from cprl.commons.game import Game
from cprl.learners.lanes import EVALUATION, EXPLORATION, lane_names, lane_seeds
from cprl.learners.settings import TabularSettings
from cprl.learners.transitions import RewardKind, lane_turn
from cprl.policies.tabular import NEVER_MET, QTables, TableNetwork, TabularActor, observed_entries, states_of


class TabularLearner:
    """R x S independent tabular agents: seats S of each of R replicas, each with a table of its own.

    A `cprl.learners.base.Learner`; its tables lie in the CPU's memory.

    Args:
        game: what is played.
        agents: the numbers of the agents that learn.
        replicas: how many replicas R, the worlds of the environment.
        settings: the hyper-parameters.
        seed: of the run.
        first_replica: the number of the first replica, so that replica r can be trained alone.
        reward_kind: what they are paid.

    Raises:
        MemoryError: in `store`, where an agent meets more than `settings.max_states` states.
    """

    def __init__(
        self,
        game: Game,
        *,
        agents: Sequence[int],
        replicas: int,
        settings: TabularSettings,
        seed: int = 0,
        first_replica: int = 0,
        reward_kind: RewardKind = "own",
    ) -> None:
        self.game, self.settings, self.seed, self.agents = game, settings, seed, tuple(agents)
        self.reward_kind = reward_kind
        self.replicas, self._numbers = replicas, range(first_replica, first_replica + replicas)
        self.tables = QTables(self.lanes, len(game.actions), max_states=settings.max_states)
        self.actor = self._actor(EXPLORATION, worlds=1)
        self.actor.epsilon = settings.epsilon(0)
        self.steps = 0
        self._observed, self._every_lane = observed_entries(game), range(self.lanes)
        self._turns: deque[dict[str, NDArray[Any]]] = deque()

    @property
    def lanes(self) -> int:
        """The number of lanes, replicas x seats."""
        return self.replicas * len(self.agents)

    def _actor(self, purpose: int, *, worlds: int) -> TabularActor:
        seeds = lane_seeds(self.seed, replicas=self._numbers, agents=self.agents, purpose=purpose)
        return TabularActor(self.tables, self.game, seeds=seeds, agents=len(self.agents), worlds=worlds)

    def evaluation_actor(self, worlds: int) -> TabularActor:
        """An actor by the same tables, with `epsilon_evaluation`, for so many worlds of each replica."""
        actor = self._actor(EVALUATION, worlds=worlds)
        actor.epsilon = self.settings.epsilon_evaluation
        return actor

    def store(self, batch: TensorDictBase) -> None:
        """Notes a turn of every replica, to be learned by the next `update`."""
        batch = batch.cpu()  # where the tables lie
        turn = lane_turn(self.agents, batch, reward_kind=self.reward_kind)
        before, after = keys.entry(batch, keys.AGENTS), keys.entry(batch, "next")
        seen = states_of(before, self._observed, self.agents)
        rows = self.tables.find_or_add(seen, self._every_lane)
        on = np.flatnonzero(~turn.terminated)
        next_seen = states_of(keys.entry(after, keys.AGENTS), self._observed, self.agents)
        next_rows = np.full(self.lanes, NEVER_MET, np.int64)
        next_rows[on] = self.tables.find_or_add([next_seen[lane] for lane in on], on.tolist())
        self._turns.append(
            {
                "row": rows,
                "action": turn.action.copy(),
                "reward": turn.reward.astype(np.float64),
                "next_row": next_rows,
            }
        )
        self.steps += 1
        self.actor.epsilon = self.settings.epsilon(self.steps)

    def update(self) -> Tensor | None:
        """Learns the oldest turn not yet learned; squared errors [R, S], or None for no such turn."""
        if not self._turns:
            return None
        turn, values = self._turns.popleft(), self.tables.values
        place = turn["row"], turn["action"]
        self.tables.visits[place] += 1  # no two lanes share a row
        target = turn["reward"] + self.settings.gamma * values[turn["next_row"]].max(1)
        error = target - values[place]
        values[place] += self.settings.rates(self.tables.visits[place]) * error
        return torch.from_numpy(error**2).view(self.replicas, len(self.agents))

    def end_episode(self, ended: Tensor) -> None:
        """Nothing is due at the end of an episode."""

    def values(self, batch: TensorDictBase) -> Tensor:
        """The highest value of each agent's actions at the end of a turn, [R, S]."""
        after = keys.entry(keys.entry(batch, "next"), keys.AGENTS)
        rows = self.tables.find(states_of(after, self._observed, self.agents), self._every_lane)
        return torch.from_numpy(self.tables.values[rows].max(1)).view(self.replicas, len(self.agents))

    def q_table(self, lane: int) -> dict[str, NDArray[Any]]:
        """What a lane has learned, a row for each of n states that it has met; for people to look at.

        Returns:
            "observation" uint8 [n, C, X, Y], "stock_gauge" float32 [n, 1] and "scoreboard" float32 [n, N]
            where the game has them, "values" float64 [n, A] and "visits" int64 [n, A].
        """
        flat, values, visits = self.tables.of_lane(lane)
        sizes = {"stock_gauge": self.game.stock_gauge_size, "scoreboard": self.game.scoreboard_size}
        cells = int(np.prod(self.game.observation_shape))
        table: dict[str, NDArray[Any]] = {
            "observation": flat[:, :cells].reshape(len(flat), *self.game.observation_shape)
        }
        vectors = np.ascontiguousarray(flat[:, cells:]).view(np.float32)
        for name in self._observed[1:]:
            table[name], vectors = vectors[:, : sizes[name]], vectors[:, sizes[name] :]
        return {**table, "values": values, "visits": visits}

    def networks(self) -> dict[str, TableNetwork]:
        """What every lane has tabulated up to now, by "replica_0/agent_0" and so on; copies.

        Raises:
            ValueError: see `Tabular.network`.
        """
        made = {}
        for name, own in self._network_states().items():
            made[name] = table_network(self.game)
            made[name].load_state_dict(own)
        return made

    def _network_states(self) -> dict[str, dict[str, Tensor]]:
        """The state dict of each lane's `TableNetwork`."""
        states = {}
        for lane, name in enumerate(lane_names(replicas=self._numbers, agents=self.agents)):
            seen, values, _ = self.tables.of_lane(lane)
            states[name] = {"states": torch.from_numpy(seen), "values": torch.from_numpy(values)}
        return states

    def state_dict(self) -> dict[str, Any]:
        """Everything that the future of all lanes depends on.

        "networks" besides, which says the same as "tables" in a form that `cprl.load` reads, where there is
        one; see `Tabular.network`.
        """
        turns = [{name: torch.from_numpy(array) for name, array in turn.items()} for turn in self._turns]
        return {
            "tables": self.tables.state_dict(),
            "networks": self._network_states() if self._observed == ("observation",) else {},
            "exploration": self.actor.rng.state_dict(),
            "steps": self.steps,
            "turns": turns,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes on where the learner of that state was, which was made with the same arguments."""
        self.tables.load_state_dict(state["tables"])
        self.actor.rng.load_state_dict(state["exploration"])
        self.steps = int(state["steps"])
        self.actor.epsilon = self.settings.epsilon(self.steps)
        self._turns = deque(
            {name: own.numpy().copy() for name, own in turn.items()} for turn in state["turns"]
        )


def table_network(game: Game) -> TableNetwork:
    """See `Tabular.network`."""
    names = observed_entries(game)
    if names != ("observation",):
        raise ValueError(
            f"agents of this game observe {', '.join(names)}; as members of a population they see only "
            "the observation: leave the others out of Observation, or hand a TabularLearner to train"
        )
    return TableNetwork(game.observation_shape, len(game.actions))
