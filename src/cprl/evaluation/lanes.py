"""Plays stored agents in fresh worlds, with all replicas at once as lanes; what came of it, by labels.

A step of all replicas takes as long as a step of one, and each lane's random numbers depend on (seed,
replica, agent) alone.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Final, Literal, NamedTuple, Protocol, Self, TypeAlias

import numpy as np
import pyarrow as pa
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from cprl.commons.game import Game
from cprl.commons.spaces import Spaces
from cprl.commons.world import Shown
from cprl.envs.commons_env import CommonsEnv
from cprl.measuring.episodes import Episode
from cprl.measuring.evaluate import evaluate
from cprl.measuring.statistics import (
    Estimate,
    Measured,
    difference,
    institution_measures,
    over_replicas,
    social_measures,
)
from cprl.policies.assignment import AgentPolicies
from cprl.policies.scripted import ScriptedPolicy
from cprl.runs.episodes import Label, labelled
from cprl.system.process import one_thread
from cprl.training.agents import LoadedRun, StoredAgent, stored_policies

Values = NDArray[np.float64]

Played: TypeAlias = dict[int, list[Episode]]
"""Episodes by the number of the replica."""

Agent: TypeAlias = Callable[[int], StoredAgent]
"""Who plays at an index, by the number of the replica."""


def agents_of(run: LoadedRun, numbers: Mapping[int, int] | None = None) -> list[Agent]:
    """The agents of a run, each at its own index.

    Args:
        numbers: the run's replica for each replica that plays, if they differ.
    """

    def agent_at(agent: int, replica: int) -> StoredAgent:
        return run.agent(agent, replica=replica if numbers is None else numbers[replica])

    return [partial(agent_at, agent) for agent in range(run.game.agents)]


def scripted(policy: ScriptedPolicy) -> Agent:
    return lambda _: StoredAgent(scripted=policy)


class Place(Protocol):
    """A game whose fresh worlds can be played, e.g. a `LoadedRun`."""

    @property
    def game(self) -> Any: ...

    @property
    def playing(self) -> Game | Spaces: ...

    def env(self, worlds: int = 1, *, seed: int = 0, first_world: int = 0) -> EnvBase: ...


@dataclass(frozen=True, kw_only=True)
class Fresh:
    """Fresh episodes of some replicas; replica r plays the worlds from r x episodes on."""

    replicas: tuple[int, ...]
    """Their numbers, ascending."""
    episodes: int
    """Of each replica with each choice of who plays where, each in its own world."""
    seed: int
    """Of the worlds and of all random numbers."""
    greedy: bool = False
    """Whether stored agents take their best action; else they explore as in evaluation."""

    def __str__(self) -> str:
        counts = {"replica": len(self.replicas), "episode": self.episodes}
        return ", ".join(f"{count} {name}{'s' * (count != 1)}" for name, count in counts.items()) + " each"

    def play(self, where: Place, agents: Sequence[Agent], *, explore: bool | None = None) -> Played:
        """The episodes by replica; agents explore unless they are greedy, or as is said."""
        explore = not self.greedy if explore is None else explore
        played: Played = {}
        for group, env in self.worlds(where):
            ended = evaluate(env, self.policies(where, agents, group), explore=explore)
            for place, replica in enumerate(group):
                played[replica] = ended[place * self.episodes : (place + 1) * self.episodes]
        return played

    def worlds(self, where: Place) -> Iterator[tuple[list[int], EnvBase]]:
        """The numbers of replicas, and an environment with their worlds in the same order, with as many
        consecutive replicas as possible in one."""
        breaks = np.flatnonzero(np.diff(self.replicas) > 1) + 1
        for group in (numbers.tolist() for numbers in np.split(np.array(self.replicas), breaks)):
            first = group[0] * self.episodes
            yield group, where.env(len(group) * self.episodes, seed=self.seed, first_world=first)

    def policies(self, where: Place, agents: Sequence[Agent], replicas: Sequence[int]) -> AgentPolicies:
        """The policies of the agents of these replicas."""
        stored = [[agent(replica) for replica in replicas] for agent in agents]
        return stored_policies(stored, where.playing, replicas=replicas, worlds=self.episodes, seed=self.seed)


Whose: TypeAlias = Literal["focal", "background", "group"]

_RETURNS: Final[Mapping[Whose, Callable[[Values, list[int]], float]]] = {
    "focal": lambda returns, focal: returns[focal].mean(),
    "background": lambda returns, focal: np.delete(returns, focal).mean(),
    "group": lambda returns, _: returns.sum(),
}
"""Of the agents' returns, float64 [N], and the indices of the focal agents."""


class Part(NamedTuple):
    """The episodes of a population."""

    labels: Label
    played: Played
    focal: tuple[tuple[int, ...], ...] = ()
    """The indices of the agents that are judged; several choices where the same episodes stand for each."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Results:
    """The episodes of labelled populations in the same fresh worlds."""

    parts: Sequence[Part] = field(repr=False)
    fresh: Fresh

    def where(self, **labels: str | int) -> Self:
        """The populations with these labels."""
        return replace(self, parts=[part for part in self.parts if labels.items() <= part.labels.items()])

    def table(self) -> pa.Table:
        """All episodes with the columns of `episodes.parquet` after the labels: a row for each population,
        replica, episode and agent."""
        return labelled(
            (labels, replica, episodes)
            for labels, played, _ in self.parts
            for replica, episodes in played.items()
        )

    @property
    def played(self) -> Played:
        """The episodes of all populations together."""
        together: Played = {}
        for part in self.parts:
            for replica, episodes in part.played.items():
                together.setdefault(replica, []).extend(episodes)
        return together

    def returns(self, whose: Whose) -> dict[int, list[float]]:
        """A return by replica, of each episode with each choice of focal agents: the mean of the focal
        agents, that of the others, or the sum of all."""
        values: dict[int, list[float]] = {}
        for part in self.parts:
            for focal in part.focal:
                for replica, episodes in part.played.items():
                    of_episodes = (float(_RETURNS[whose](one.return_, list(focal))) for one in episodes)
                    values.setdefault(replica, []).extend(of_episodes)
        return values

    def mean_returns(self, whose: Whose) -> Values:
        """The means of `returns`, [R]."""
        returns = self.returns(whose)
        return np.array([np.mean(returns[replica]) for replica in self.fresh.replicas])

    def estimates(self, *whose: Whose) -> dict[str, Measured]:
        """Over replicas by name: these returns as `focal/return` and so on, the social metrics, and those of
        institutions as `institutions/fines` and so on."""
        returns = {f"{name}/return": over_replicas(self.returns(name)) for name in whose}
        return {**returns, **social_measures(self.played), **institution_measures(self.played)}


def more(reached: Results, usual: Results, whose: Whose) -> Estimate:
    """How much higher a return is in the first results, paired by replica, which played the same worlds."""
    return difference(reached.mean_returns(whose), usual.mean_returns(whose), paired=True)


Policy = Callable[[TensorDictBase], TensorDictBase]


class Turns:
    """An episode that is played turn by turn, with the exploration of training and evaluation.

    Unlike a collector it does not reset an environment that has ended, so that the last board can be seen.

    Args:
        env: one world, batch size [1], with its transforms; it is reset.
        policy: writes the actions of all agents, e.g. `cprl.policies.assignment.AgentPolicies`.
    """

    def __init__(self, env: EnvBase, policy: Policy) -> None:
        self.env, self.policy = env, policy
        self._moment: TensorDictBase = env.reset()
        self.has_ended = False

    def play(self) -> TensorDictBase:
        """Plays the next turn; returns its entries, batch size [1], see `cprl.keys`."""
        if self.has_ended:
            raise ValueError("the episode has ended; allowed: turns up to its end")
        env = self.env
        with torch.no_grad(), one_thread(), set_exploration_type(ExplorationType.RANDOM):
            batch: TensorDictBase = env.step(self.policy(self._moment))
        self._moment = step_mdp(
            batch, reward_keys=env.reward_keys, action_keys=env.action_keys, done_keys=env.done_keys
        )
        self.has_ended = bool(batch["next", "done"].any())
        return batch


def board_now(env: CommonsEnv) -> Shown:
    """The board of one world without what agents observe."""
    board = env.worlds.show(env.output)
    return board._replace(observation=board.observation[:0])
