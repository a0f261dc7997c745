"""How agents vote: `Decider`, the part of a policy that chooses on ballots, and `Bandit`, a learner of votes.

In games with votes or elections all agents decide when an episode begins. An agent's decision, the entry
("agents", "decision"), is one number that says its choices on all ballots, see `cprl.Game.ballots`. Choices
on different ballots are learned separately: V ballots with 5 choices each are V tables of 5 values, and not
one table of 5**V.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import torch
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type

from cprl.policies.rng import Purpose, lane_names, lane_seeds
from cprl.values import Positive, Range, Share, Value
from cprl.values.array_types import Bool, Float64, Int64

UNTRIED = -np.inf
"""The value of a choice that an agent has never made."""


def ballot_sizes(game: Any) -> tuple[int, ...]:
    """Return the number of choices of each ballot of a game; () for one without ballots, of whatever kind."""
    return tuple(len(ballot.choices) for ballot in getattr(game, "ballots", ()))


def choices_of(decision: Int64, sizes: Sequence[int]) -> Int64:
    """Return the choices on V ballots, int64 [..., V], that some decisions, int64 [...], stand for.

    The first ballot changes fastest: with 3 and 2 choices decision 4 is the choices (1, 1).

    Args:
        sizes: the number of choices of each ballot.
    """
    return np.stack(np.unravel_index(decision, tuple(sizes), order="F"), -1)


def decision_of(choices: Int64, sizes: Sequence[int]) -> Int64:
    """Return the decisions, int64 [...], that stand for some choices, int64 [..., V]; see `choices_of`."""
    strides = np.cumprod([1, *sizes[:-1]], dtype=np.int64)
    return (choices * strides).sum(-1)


class Decider(nn.Module):
    """Decides for the N agents of k worlds of each of R replicas; it learns nothing.

    An agent chooses on a ballot when the ballot is due, and keeps its choice until it is due again. It takes
    the choice with the highest value, the first of equal ones. With probability `epsilon` it takes any choice
    instead, all equally likely, under `ExplorationType.RANDOM` alone. The random numbers of an agent depend
    only on its own seed, its world, and how often it has decided there.

    Args:
        sizes: the number of choices of each of V ballots, see `ballot_sizes`.
        seeds: the seed of each lane, lane = replica x N + agent.
        agents: the number of agents N.
        worlds: the number of worlds k of each replica, consecutive in the batch.
        stored: the values that agents learned, float64 [C] for each replica, by agent: those of the C choices
            of all ballots, ballot after ballot; `UNTRIED` for a choice that was never made. Agents that are
            not in it always choose at random.

    `values`, float64 [R, N, C], and `by_chance`, bool [N], say so of all agents.
    `epsilon`, float64 [R, N], initially 0, is the probability of a random choice of each agent.
    """

    def __init__(
        self,
        sizes: Sequence[int],
        *,
        seeds: Sequence[Sequence[int]],
        agents: int,
        worlds: int = 1,
        stored: Mapping[int, Sequence[Tensor]],
    ) -> None:
        super().__init__()
        self.sizes = tuple(sizes)
        self.agents = agents
        self.worlds = worlds
        self.replicas = len(seeds) // agents
        self._seeds = seeds
        self.values = np.full((self.replicas, agents, sum(self.sizes)), UNTRIED)
        for agent, values in stored.items():
            self.values[:, agent] = torch.stack(list(values)).numpy(force=True)
        self.by_chance = np.array([agent not in stored for agent in range(agents)])
        self.epsilon = np.zeros((self.replicas, agents))
        batch = self.replicas * self.worlds
        self._choices = np.zeros((batch, self.agents, len(self.sizes)), np.int64)
        """The latest choice of each agent of each world on each ballot, [R x k, N, V]."""
        self._decided = np.zeros(batch, np.int64)
        """How often the agents of each world have decided, [R x k]."""
        self._decisions: Tensor | None = None
        """The decisions that stand for `_choices`, [R x k, N]; None before the first."""

    def decide(self, due: Tensor) -> Tensor:
        """Return the decisions of all agents, int64 [R x k, N]; the tensor is not changed later.

        Args:
            due: bool [R x k, V], marks the ballots that are held in the coming turn.
        """
        is_due = due.numpy(force=True)
        if self._decisions is None or np.count_nonzero(is_due):
            self._choose(is_due)
            self._set_decisions(due.device)
        assert self._decisions is not None
        return self._decisions

    def _set_decisions(self, device: torch.device | str) -> None:
        """Make the decisions that stand for the latest choices."""
        decisions = torch.from_numpy(decision_of(self._choices, self.sizes)).to(device)
        object.__setattr__(self, "_decisions", decisions)  # past the checks of modules, which take longer

    def learn(self, replica: int, decision: Int64, returns: Float64) -> None:
        """Learn from an episode that has ended; this class learns nothing.

        Args:
            replica: the index of the replica that played the episode.
            decision: int64 [N], the agents' decisions in it.
            returns: float64 [N], the agents' returns by the rewards that they learn from.
        """

    def _choose(self, due: Bool) -> None:
        """Replace the choices on the ballots that are due, bool [R x k, V]."""
        worlds = np.flatnonzero(due.any(1))
        replicas = worlds // self.worlds
        numbers = self._draw_numbers(worlds)
        may_explore = exploration_type() in (ExplorationType.RANDOM, None)
        epsilon = self.epsilon[replicas] if may_explore else np.zeros((len(worlds), self.agents))
        epsilon = np.where(self.by_chance, 1.0, epsilon)
        random_choices = (numbers[..., 1] * self.sizes).astype(np.int64)
        explores = numbers[..., 0] < epsilon[..., None]
        new_choices = np.where(explores, random_choices, self.best()[replicas])
        self._choices[worlds] = np.where(due[worlds, None], new_choices, self._choices[worlds])

    def best(self) -> Int64:
        """Return the choice with the highest value on each ballot, int64 [R, N, V]."""
        by_ballot = np.split(self.values, np.cumsum(self.sizes)[:-1], axis=-1)
        return np.stack([values.argmax(-1) for values in by_ballot], -1)

    def _draw_numbers(self, worlds: Int64) -> Float64:
        """Draw two uniform numbers in 0..1 for each agent and ballot of some worlds, [n, N, V, 2].

        An agent's seed is that of its lane and how often it has decided before; one generator of this seed
        draws the numbers of all worlds of the replica.

        Args:
            worlds: the indices of n worlds in the batch.
        """
        numbers = np.empty((len(worlds), self.agents, len(self.sizes), 2))
        replica_and_decided = np.stack([worlds // self.worlds, self._decided[worlds]], 1)
        for replica, decided in np.unique(replica_and_decided, axis=0).tolist():
            is_drawn = (replica_and_decided == (replica, decided)).all(1)
            rows = np.flatnonzero(is_drawn)
            for agent in range(self.agents):
                seed = np.random.SeedSequence((*self._seeds[replica * self.agents + agent], decided))
                drawn = np.random.Generator(np.random.Philox(seed)).random((self.worlds, len(self.sizes), 2))
                numbers[rows, agent] = drawn[worlds[rows] % self.worlds]
        self._decided[worlds] += 1
        return numbers

    def get_extra_state(self) -> dict[str, Any]:
        return {"choices": torch.tensor(self._choices), "decided": torch.tensor(self._decided)}

    def set_extra_state(self, state: Mapping[str, Any]) -> None:
        self._choices[:] = state["choices"].numpy(force=True)
        self._decided[:] = state["decided"].numpy(force=True)
        if self._decisions is not None or self._decided.any():
            device = "cpu" if self._decisions is None else self._decisions.device
            self._set_decisions(device)


@dataclass(frozen=True, kw_only=True)
class Bandit(Value):
    """How an agent learns to vote: an epsilon-greedy bandit with a value for each choice of each ballot.

    After an episode with return G, the value Q of the choice that the agent made in it becomes
    Q + step (G - Q). The step is 1 over the number of times that this choice was made, and at least
    `step_size`. So a value is first the plain mean of returns; later it follows what other agents learn.

    Source: Sutton and Barto, "Reinforcement Learning" (2nd edition, 2018), sections 2.4 and 2.5.
    """

    step_size: Annotated[float, Range(1e-6, 1)] = 0.1
    """The smallest share by which a value moves towards a return."""
    epsilon_start: Share = 1.0
    """Probability of a random choice in the first episode. While other agents choose at random, one vote
    often decides the outcome, so that the agent sees what its vote is worth."""
    epsilon_end: Share = 0.1
    """Probability of a random choice after the decay."""
    epsilon_decay_episodes: Positive = 100
    """Episodes of the linear decay."""

    def epsilon(self, episode: int) -> float:
        """Return the probability of a random choice in an episode, counted from 0."""
        decay_share = min(1.0, episode / self.epsilon_decay_episodes)
        return self.epsilon_start + decay_share * (self.epsilon_end - self.epsilon_start)


class BanditDecider(Decider):
    """A decider of R replicas in which some agents learn to vote, each from the episodes of all worlds of its
    replica.

    Args:
        sizes: see `Decider`, also for `worlds`.
        bandits: by agent; None for agents that do not learn to vote.
        stored: the values of agents of earlier runs, see `Decider`. Agents with neither such values nor a
            bandit choose at random.
        replicas: the number of replicas R.
        seed: the seed of the run.
        first_replica: the index of the first replica.
    """

    def __init__(
        self,
        sizes: Sequence[int],
        *,
        bandits: Sequence[Bandit | None],
        stored: Mapping[int, Sequence[Tensor]],
        replicas: int,
        worlds: int = 1,
        seed: int,
        first_replica: int = 0,
    ) -> None:
        agents = len(bandits)
        self._seed = seed
        self._replica_indices = range(first_replica, first_replica + replicas)
        seeds = lane_seeds(
            seed, replicas=self._replica_indices, agents=range(agents), purpose=Purpose.DECISIONS
        )
        super().__init__(sizes, seeds=seeds, agents=agents, worlds=worlds, stored=stored)
        self.by_chance &= np.array([bandit is None for bandit in bandits])
        self.bandits = tuple(bandits)
        self.times = np.zeros(self.values.shape, np.int64)
        """int64 [R, N, C], the number of episodes from which each choice was learned."""
        self.episodes = np.zeros(replicas, np.int64)
        """int64 [R], the number of episodes that each replica has learned from."""
        self._update_epsilon()

    def learn(self, replica: int, decision: Int64, returns: Float64) -> None:
        """Learn from an episode, see `Decider.learn`; a return that is not finite changes no value."""
        first_columns = np.cumsum([0, *self.sizes[:-1]])  # of each ballot in `values`
        columns_by_agent = choices_of(decision, self.sizes) + first_columns
        for agent, columns in enumerate(columns_by_agent):
            bandit = self.bandits[agent]
            if bandit is None or not np.isfinite(returns[agent]):
                continue
            for column in columns:
                self.times[replica, agent, column] += 1
                times = self.times[replica, agent, column]
                value = 0.0 if times == 1 else self.values[replica, agent, column]
                step = max(bandit.step_size, 1 / times)
                self.values[replica, agent, column] = value + step * (returns[agent] - value)
        self.episodes[replica] += 1
        self._update_epsilon()

    def _update_epsilon(self) -> None:
        """Set the epsilon of each agent that learns to that of the current episode of its replica."""
        for agent, bandit in enumerate(self.bandits):
            if bandit is not None:
                self.epsilon[:, agent] = [bandit.epsilon(episode) for episode in self.episodes.tolist()]

    def without_exploration(self, purpose: Purpose, *, replicas: int, worlds: int) -> Decider:
        """Return a decider of the same agents that does not explore, and follows what they learn.

        Args:
            purpose: the purpose of its random numbers.
            replicas: the number of replicas, from the first on.
            worlds: the number of worlds of each replica.
        """
        indices = self._replica_indices[:replicas]
        seeds = lane_seeds(self._seed, replicas=indices, agents=range(self.agents), purpose=purpose)
        decider = Decider(self.sizes, seeds=seeds, agents=self.agents, worlds=worlds, stored={})
        decider.values = self.values[:replicas]
        decider.by_chance = self.by_chance
        return decider

    def learned(self) -> dict[str, Tensor]:
        """Return copies of the values of the agents that learn, float64 [C], by "replica_0/agent_0" and so
        on."""
        learning = [agent for agent, bandit in enumerate(self.bandits) if bandit is not None]
        names = lane_names(replicas=self._replica_indices, agents=learning)
        return dict(zip(names, torch.tensor(self.values[:, learning]).flatten(0, 1), strict=True))

    def get_extra_state(self) -> dict[str, Any]:
        """Return the state of all agents, from which training continues exactly; part of `state_dict`."""
        arrays = {"values": self.values, "times": self.times, "episodes": self.episodes}
        copies = {name: torch.tensor(array) for name, array in arrays.items()}
        return {**super().get_extra_state(), **copies, "learned": self.learned()}

    def set_extra_state(self, state: Mapping[str, Any]) -> None:
        super().set_extra_state(state)
        for name in ("values", "times", "episodes"):
            getattr(self, name)[:] = state[name].numpy(force=True)
        self._update_epsilon()
