"""Decider: what all agents decide at an episode's begin, ("agents", "decision"), as part of a policy.

A decision is one number for all ballots of a game, see `cprl.institutions.votes.ballots_of`. Here each
ballot's choice is made by itself: V ballots with 5 choices each are V tables of 5 values, not one of 5**V.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type

from cprl.commons.game import Game

Longs = NDArray[np.int64]
Doubles = NDArray[np.float64]

UNTRIED = -np.inf
"""The value of a choice that an agent has never made."""


def ballot_sizes(game: Game) -> tuple[int, ...]:
    """The number of choices of each ballot of a game."""
    return tuple(len(ballot.choices) for ballot in game.ballots)


def choices_of(decision: Longs, sizes: Sequence[int]) -> Longs:
    """The choice on each ballot, int64 [..., V], that decisions, int64 [...], make."""
    return np.stack(np.unravel_index(decision, tuple(sizes), order="F"), -1)


def decision_of(choices: Longs, sizes: Sequence[int]) -> Longs:
    """The decisions, int64 [...], that make these choices, int64 [..., V]."""
    places = np.cumprod([1, *sizes[:-1]], dtype=np.int64)
    decisions: Longs = (choices * places).sum(-1)
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
        values: Doubles | None = None,
        epsilon: Doubles | None = None,
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

    def learn(self, replica: int, decision: Longs, returns: Doubles) -> None:
        """Learns from an episode of a replica that has ended.

        Args:
            decision: int64 [N], what the agents had decided.
            returns: float64 [N], what each of them wants to be high.
        """

    def _choose(self, due: NDArray[np.bool_]) -> None:
        """Chooses anew on the ballots that are due, bool [R x k, V]."""
        worlds = np.flatnonzero(due.any(1))
        replicas, numbers = worlds // self.worlds, self._numbers(worlds)
        explores = exploration_type() in (ExplorationType.RANDOM, None)
        chance = self.epsilon[replicas] if explores else np.zeros((len(worlds), self.agents))
        chance = np.where(self.by_chance, 1.0, chance)
        drawn = (numbers[..., 1] * self.sizes).astype(np.int64)
        new = np.where(numbers[..., 0] < chance[..., None], drawn, self.best()[replicas])
        self._choices[worlds] = np.where(due[worlds, None], new, self._choices[worlds])

    def best(self) -> Longs:
        """The choice with the highest value on each ballot, int64 [R, N, V]."""
        of_ballots = np.split(self.values, np.cumsum(self.sizes)[:-1], axis=-1)
        return np.stack([values.argmax(-1) for values in of_ballots], -1)

    def _numbers(self, worlds: Longs) -> Doubles:
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


def decider_by_chance(game: Game, seeds: Sequence[Sequence[int]], *, worlds: int = 1) -> Decider | None:
    """Agents of a game who choose by chance, all choices equally likely; None where nothing is decided."""
    sizes = ballot_sizes(game)
    return Decider(sizes, seeds=seeds, agents=game.agents, worlds=worlds) if sizes else None
