"""Decider: what all agents decide at an episode's begin, ("agents", "decision"), as part of a policy; and
Bandit, how agents learn it from the returns of episodes.

A decision is one number for all ballots of a game, see `cprl.Game.ballots`. Here each ballot's choice is made
by itself: V ballots with 5 choices each are V tables of 5 values, not one of 5**V.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import torch
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type

from cprl.commons.game import Game
from cprl.policies.rng import Purpose, lane_names, lane_seeds
from cprl.values import Positive, Range, Share, Value
from cprl.values.arrays import Bool, Float64, Int64

UNTRIED = -np.inf
"""The value of a choice that an agent has never made."""


def ballot_sizes(game: Game) -> tuple[int, ...]:
    """The number of choices of each ballot of a game."""
    return tuple(len(ballot.choices) for ballot in game.ballots)


def choices_of(decision: Int64, sizes: Sequence[int]) -> Int64:
    """The choice on each ballot, int64 [..., V], that decisions, int64 [...], make."""
    return np.stack(np.unravel_index(decision, tuple(sizes), order="F"), -1)


def decision_of(choices: Int64, sizes: Sequence[int]) -> Int64:
    """The decisions, int64 [...], that make these choices, int64 [..., V]."""
    places = np.cumprod([1, *sizes[:-1]], dtype=np.int64)
    decisions: Int64 = (choices * places).sum(-1)
    return decisions


class Decider(nn.Module):
    """Decides for the N agents of k worlds of each of R replicas; this one learns nothing.

    An agent chooses on a ballot when it is due, and keeps its choice until it is due again. It takes the
    choice with the highest value, of equal ones the first, or with probability `epsilon` any, all equally
    likely; it does the latter under `ExplorationType.RANDOM` alone. Agents `by_chance` always choose so. The
    numbers that an agent draws depend on its own seed, its world and how often it has decided there, on
    nothing else.

    Args:
        sizes: the number of choices of each ballot, V of them, see `ballot_sizes`.
        seeds: of each lane, lane = replica x N + agent.
        agents: the number of agents N.
        worlds: the number of worlds k of each replica, consecutive in the batch.
        values: float64 [R, N, C] for the C choices of all ballots one after the other, `UNTRIED` where there
            is none; not copied, so that it follows what is learned. None for agents that all decide by
            chance.
        epsilon: float64 [R, N], 0..1, likewise; None for 0.
        by_chance: bool [N]; None for nobody.
    """

    def __init__(
        self,
        sizes: Sequence[int],
        *,
        seeds: Sequence[Sequence[int]],
        agents: int,
        worlds: int = 1,
        values: Float64 | None = None,
        epsilon: Float64 | None = None,
        by_chance: Sequence[bool] | None = None,
    ) -> None:
        super().__init__()
        self.sizes = tuple(sizes)
        self.agents, self.worlds, self.replicas = agents, worlds, len(seeds) // agents
        self._seeds = [tuple(seed) for seed in seeds]
        of_agents = self.replicas, self.agents
        self.values = np.zeros((*of_agents, sum(self.sizes))) if values is None else values
        self.epsilon = np.zeros(of_agents) if epsilon is None else epsilon
        self.by_chance = np.full(self.agents, values is None)
        if by_chance is not None:
            self.by_chance |= np.array(by_chance, np.bool_)
        batch = self.replicas * self.worlds
        self._choices = np.zeros((batch, self.agents, len(self.sizes)), np.int64)
        self._decided = np.zeros(batch, np.int64)
        self._held: Tensor | None = None

    def decide(self, due: Tensor) -> Tensor:
        """Return the decisions of all agents, int64 [R x k, N], which do not change later.

        `due`, bool [R x k, V], says which ballots are held in the coming turn."""
        held = due.numpy(force=True)
        if self._held is None or np.count_nonzero(held):
            self._choose(held)
            decisions = decision_of(self._choices, self.sizes)
            object.__setattr__(self, "_held", torch.from_numpy(decisions).to(due.device))
        assert self._held is not None
        return self._held

    def learn(self, replica: int, decision: Int64, returns: Float64) -> None:
        """Learns from an episode of a replica that has ended.

        Args:
            decision: int64 [N], what the agents had decided.
            returns: float64 [N], what each of them wants to be high.
        """

    def _choose(self, due: Bool) -> None:
        """Chooses anew on the ballots that are due, bool [R x k, V]."""
        worlds = np.flatnonzero(due.any(1))
        replicas, numbers = worlds // self.worlds, self._numbers(worlds)
        explores = exploration_type() in (ExplorationType.RANDOM, None)
        chance = self.epsilon[replicas] if explores else np.zeros((len(worlds), self.agents))
        chance = np.where(self.by_chance, 1.0, chance)
        drawn = (numbers[..., 1] * self.sizes).astype(np.int64)
        new = np.where(numbers[..., 0] < chance[..., None], drawn, self.best()[replicas])
        self._choices[worlds] = np.where(due[worlds, None], new, self._choices[worlds])

    def best(self) -> Int64:
        """The choice with the highest value on each ballot, int64 [R, N, V]."""
        of_ballots = np.split(self.values, np.cumsum(self.sizes)[:-1], axis=-1)
        return np.stack([values.argmax(-1) for values in of_ballots], -1)

    def _numbers(self, worlds: Int64) -> Float64:
        """Two uniform numbers in 0..1 for each of these worlds, agent and ballot, [worlds, N, V, 2]."""
        numbers = np.empty((len(worlds), self.agents, len(self.sizes), 2))
        together = np.stack([worlds // self.worlds, self._decided[worlds]], 1)
        for replica, decided in np.unique(together, axis=0).tolist():
            at = np.flatnonzero((together == (replica, decided)).all(1))
            for agent in range(self.agents):
                seed = np.random.SeedSequence((*self._seeds[replica * self.agents + agent], decided))
                drawn = np.random.Generator(np.random.Philox(seed)).random((self.worlds, len(self.sizes), 2))
                numbers[at, agent] = drawn[worlds[at] % self.worlds]
        self._decided[worlds] += 1
        return numbers

    def get_extra_state(self) -> dict[str, Any]:
        return {"choices": torch.tensor(self._choices), "decided": torch.tensor(self._decided)}

    def set_extra_state(self, state: Mapping[str, Any]) -> None:
        self._choices[:] = state["choices"].numpy(force=True)
        self._decided[:] = state["decided"].numpy(force=True)
        held = self._held
        if held is not None or self._decided.any():
            device = "cpu" if held is None else held.device
            decisions = torch.from_numpy(decision_of(self._choices, self.sizes)).to(device)
            object.__setattr__(self, "_held", decisions)


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
    """The agents of R replicas, of which some learn their decisions, beside others that do not; those of a
    replica learn from the episodes of all of its worlds.

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
        worlds: int = 1,
        seed: int,
        first_replica: int = 0,
    ) -> None:
        agents = len(bandits)
        self._seed = seed
        self._numbers_of_replicas = range(first_replica, first_replica + replicas)
        super().__init__(
            sizes,
            seeds=lane_seeds(
                seed,
                replicas=self._numbers_of_replicas,
                agents=range(agents),
                purpose=Purpose.DECISIONS,
            ),
            agents=agents,
            worlds=worlds,
            values=_table(sizes, stored, replicas=replicas, agents=agents),
            epsilon=np.zeros((replicas, agents)),
            by_chance=[bandit is None and agent not in stored for agent, bandit in enumerate(bandits)],
        )
        self.bandits = tuple(bandits)
        self.times = np.zeros(self.values.shape, np.int64)
        """int64 [R, N, C], how often each choice was learned from."""
        self.episodes = np.zeros(replicas, np.int64)
        """int64 [R], episodes learned from."""
        self._explore_as_due()

    def learn(self, replica: int, decision: Int64, returns: Float64) -> None:
        """Learns from an episode of a replica; a return that is not finite is left out."""
        firsts = np.cumsum([0, *self.sizes[:-1]])
        for agent, made in enumerate(choices_of(decision, self.sizes) + firsts):
            bandit = self.bandits[agent]
            if bandit is None or not np.isfinite(returns[agent]):
                continue
            for choice in made:
                self.times[replica, agent, choice] += 1
                times, value = self.times[replica, agent, choice], self.values[replica, agent, choice]
                before = 0.0 if times == 1 else value
                step = max(bandit.step_size, 1 / times)
                self.values[replica, agent, choice] = before + step * (returns[agent] - before)
        self.episodes[replica] += 1
        self._explore_as_due()

    def _explore_as_due(self) -> None:
        for agent, bandit in enumerate(self.bandits):
            if bandit is not None:
                self.epsilon[:, agent] = [bandit.epsilon(episode) for episode in self.episodes.tolist()]

    def evaluation(self, worlds: int) -> Decider:
        """The same agents without exploration, for `worlds` worlds of each replica."""
        return self._without_exploration(Purpose.EVALUATED_DECISIONS, self.replicas, worlds)

    def first_replica(self) -> Decider:
        """The same agents in one world of the first replica, without exploration at first."""
        return self._without_exploration(Purpose.EXHIBITED_DECISIONS, 1, 1)

    def _without_exploration(self, purpose: Purpose, replicas: int, worlds: int) -> Decider:
        numbers = self._numbers_of_replicas[:replicas]
        return Decider(
            self.sizes,
            seeds=lane_seeds(self._seed, replicas=numbers, agents=range(self.agents), purpose=purpose),
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
    game: Game,
    stored: Mapping[int, Sequence[Tensor]],
    *,
    replicas: Sequence[int],
    worlds: int,
    seed: int,
    purpose: Purpose = Purpose.EVALUATED_DECISIONS,
) -> Decider | None:
    """Return what agents decide by values of earlier runs, without exploration; None in a game that asks
    nothing.

    Args:
        stored: as of `BanditDecider`; agents that are not here decide by chance.
        purpose: what their random numbers are for.
    """
    sizes = ballot_sizes(game)
    if not sizes:
        return None
    return Decider(
        sizes,
        seeds=lane_seeds(seed, replicas=replicas, agents=range(game.agents), purpose=purpose),
        agents=game.agents,
        worlds=worlds,
        values=_table(sizes, stored, replicas=len(replicas), agents=game.agents),
        by_chance=[agent not in stored for agent in range(game.agents)],
    )


def _table(
    sizes: Sequence[int], stored: Mapping[int, Sequence[Tensor]], *, replicas: int, agents: int
) -> Float64:
    """The values of all choices, float64 [R, N, C]."""
    values = np.full((replicas, agents, sum(sizes)), UNTRIED)
    for agent, of_replicas in stored.items():
        values[:, agent] = torch.stack(list(of_replicas)).numpy(force=True)
    return values
