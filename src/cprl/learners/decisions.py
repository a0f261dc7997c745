"""How agents learn what to decide: a bandit for each ballot of each agent, by the returns of episodes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Final

import numpy as np
import torch
from torch import Tensor

from cprl.commons.game import Game
from cprl.learners.base import EVALUATION, EXHIBITION, EXPLORATION, lane_names, lane_seeds
from cprl.policies.decisions import UNTRIED, Decider, Doubles, Longs, ballot_sizes, choices_of
from cprl.values import Positive, Range, Share, Value

_OF_DECISIONS: Final = 16
"""Added to the purpose of a lane's random numbers, so that decisions have some of their own."""


def decision_seeds(
    seed: int, *, replicas: Sequence[int], agents: int, purpose: int
) -> list[tuple[int, int, int, int]]:
    return lane_seeds(seed, replicas=replicas, agents=range(agents), purpose=_OF_DECISIONS + purpose)


@dataclass(frozen=True, kw_only=True)
class Bandit(Value):
    """How an agent learns its decisions: epsilon-greedy, with a value for each choice of each ballot.

    After an episode with the return G the value of the choice that was in it moves towards G, by
    Q + step (G - Q), where the step is 1 over the number of times that it was made, and never below
    `step_size`. The first numbers are thus plain means; later ones follow what others learn meanwhile.

    Source: Sutton and Barto, "Reinforcement Learning" (2nd edition, 2018), sections 2.4 and 2.5.
    """

    step_size: Annotated[float, Range(1e-6, 1)] = 0.1
    """The smallest step by which a value moves towards a return."""
    epsilon_start: Share = 1.0
    """Probability of a random choice in the first episode. While others choose at random, a vote often
    decides, so its value shows."""
    epsilon_end: Share = 0.1
    """Probability of a random choice after the decay."""
    epsilon_decay_episodes: Positive = 100
    """Episodes of the linear decay."""

    def epsilon(self, episode: int) -> float:
        """The probability of a random choice in an episode, counted from 0."""
        done = min(1.0, episode / self.epsilon_decay_episodes)
        return self.epsilon_start + done * (self.epsilon_end - self.epsilon_start)


class BanditDecider(Decider):
    """The agents of R replicas, of which some learn their decisions, beside others that do not.

    Args:
        bandits: by agent; None for those that do not learn.
        stored: the values, float64 [C] for each replica, of those that decide by what they have learned in an
            earlier run, by agent. Agents that are neither here nor have a bandit decide by chance.
    """

    def __init__(
        self,
        sizes: Sequence[int],
        *,
        bandits: Sequence[Bandit | None],
        stored: Mapping[int, Sequence[Tensor]],
        replicas: int,
        seed: int,
        first_replica: int = 0,
    ) -> None:
        agents, self._seed = len(bandits), seed
        self._numbers_of_replicas = range(first_replica, first_replica + replicas)
        values = np.full((replicas, agents, sum(sizes)), UNTRIED)
        for agent, of_replicas in stored.items():
            values[:, agent] = torch.stack(list(of_replicas)).numpy(force=True)
        super().__init__(
            sizes,
            seeds=self._seeds_for(EXPLORATION, replicas, agents),
            agents=agents,
            values=values,
            epsilon=np.zeros((replicas, agents)),
            by_chance=[bandit is None and agent not in stored for agent, bandit in enumerate(bandits)],
        )
        self.bandits = tuple(bandits)
        self.times = np.zeros(values.shape, np.int64)
        """int64 [R, N, C], how often each choice was learned from."""
        self.episodes = np.zeros(replicas, np.int64)
        """int64 [R], episodes learned from."""
        self._explore_as_due()

    def _seeds_for(self, purpose: int, replicas: int, agents: int) -> list[tuple[int, int, int, int]]:
        numbers = self._numbers_of_replicas[:replicas]
        return decision_seeds(self._seed, replicas=numbers, agents=agents, purpose=purpose)

    def learn(self, replica: int, decision: Longs, returns: Doubles) -> None:
        """Learns from an episode of a replica; a return that is not finite is left out."""
        firsts = np.cumsum([0, *self.sizes[:-1]])
        for agent, made in enumerate(choices_of(decision, self.sizes) + firsts):
            bandit = self.bandits[agent]
            if bandit is None or not np.isfinite(returns[agent]):
                continue
            for choice in made:
                self.times[replica, agent, choice] += 1
                times, value = self.times[replica, agent, choice], self.values[replica, agent, choice]
                step = max(bandit.step_size, 1 / times)
                before = 0.0 if times == 1 else value
                self.values[replica, agent, choice] = before + step * (returns[agent] - before)
        self.episodes[replica] += 1
        self._explore_as_due()

    def _explore_as_due(self) -> None:
        for agent, bandit in enumerate(self.bandits):
            if bandit is not None:
                self.epsilon[:, agent] = [bandit.epsilon(episode) for episode in self.episodes.tolist()]

    def evaluation(self, worlds: int) -> Decider:
        """The same agents without exploration, for `worlds` worlds of each replica."""
        return self._without_exploration(EVALUATION, self.replicas, worlds)

    def first_replica(self) -> Decider:
        """The same agents in one world of the first replica, without exploration at first."""
        return self._without_exploration(EXHIBITION, 1, 1)

    def _without_exploration(self, purpose: int, replicas: int, worlds: int) -> Decider:
        return Decider(
            self.sizes,
            seeds=self._seeds_for(purpose, replicas, self.agents),
            agents=self.agents,
            worlds=worlds,
            values=self.values[:replicas],
            by_chance=self.by_chance.tolist(),
        )

    def learned(self) -> dict[str, Tensor]:
        """A copy of the values of each agent that learns, float64 [C], by "replica_0/agent_0" and so on."""
        learning = [agent for agent, bandit in enumerate(self.bandits) if bandit is not None]
        names = lane_names(replicas=self._numbers_of_replicas, agents=learning)
        return dict(zip(names, torch.tensor(self.values[:, learning]).flatten(0, 1), strict=True))

    def get_extra_state(self) -> dict[str, Any]:
        """All that the future depends on; part of `state_dict`."""
        arrays = {"values": self.values, "times": self.times, "episodes": self.episodes}
        copies = {name: torch.tensor(array) for name, array in arrays.items()}
        return {**super().get_extra_state(), **copies, "learned": self.learned()}

    def set_extra_state(self, state: Mapping[str, Any]) -> None:
        super().set_extra_state(state)
        for name in ("values", "times", "episodes"):
            getattr(self, name)[:] = state[name].numpy(force=True)
        self._explore_as_due()


def stored_decisions(
    values: Sequence[Sequence[Tensor | None]],
    game: Game,
    *,
    replicas: Sequence[int],
    worlds: int,
    seed: int,
) -> Decider | None:
    """What agents decide by values of earlier runs, without exploration; None in a game that asks nothing.

    Args:
        values: float64 [C] by agent and replica, see `BanditDecider.learned`; None for agents by chance.
    """
    sizes = ballot_sizes(game)
    if not sizes:
        return None
    stored = np.full((len(replicas), len(values), sum(sizes)), UNTRIED)
    for agent, of_replicas in enumerate(values):
        for place, of_replica in enumerate(of_replicas):
            if of_replica is not None:
                stored[place, agent] = of_replica.numpy(force=True)
    return Decider(
        sizes,
        seeds=decision_seeds(seed, replicas=replicas, agents=len(values), purpose=EVALUATION),
        agents=len(values),
        worlds=worlds,
        values=stored,
        by_chance=[of_replicas[0] is None for of_replicas in values],
    )
