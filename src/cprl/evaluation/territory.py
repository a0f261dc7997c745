"""territory_of: where the agents of a stored run go in fresh worlds and whom they tag, beside random play."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from cprl import arguments
from cprl.commons.game import Game
from cprl.evaluation.evaluate import SEED, check, chosen_replicas, opened
from cprl.evaluation.lanes import Source, fresh_worlds, policies_of, random_policies
from cprl.measuring import territory
from cprl.measuring.movement import Trace, overlap, trace, visits
from cprl.measuring.statistics import Estimate, estimate
from cprl.policies.assignment import AgentPolicies
from cprl.stored import LoadedRun

Array = NDArray[Any]
Policy = Literal["trained", "random"]
POLICIES: Final[tuple[Policy, ...]] = get_args(Policy)

EXCLUSION: Final = "exclusion (0 to 1)"
VISITORS: Final = "agents that share a cell"
OVERLAP: Final = "overlap of two agents within an episode (0 to 1)"
TAGS: Final = "tags per 1000 steps"
DEFENCE: Final = "tags in one's own territory (0 to 1)"


@dataclass(frozen=True, kw_only=True, eq=False)
class Stays:
    """Where agents were and whom they tagged, by replica."""

    visits: Array
    """float64 [R, N, H, W], the share of its time of each agent in each cell, mean over episodes."""
    taggings: Array
    """int64 [R, N, N], how often the agent of the row was tagged by that of the column, in all episodes."""
    tagged_where: Array
    """int64 [R, N, H, W], how often each agent was tagged in each cell, in all episodes."""
    by_replica: dict[str, Array]
    """float64 [R] each: exclusion, agents that share a cell and tags in one's own territory, of the visits of
    all episodes; overlap, mean over episodes; tags per 1000 steps. NaN where a measure is undefined."""

    def measures(self) -> dict[str, Estimate]:
        """The mean over the replicas in which each measure is defined, if there are any, and its interval."""
        defined = {name: values[np.isfinite(values)] for name, values in self.by_replica.items()}
        return {name: estimate(values) for name, values in defined.items() if len(values)}


@dataclass(frozen=True, kw_only=True, eq=False)
class Territory:
    """Where a run's agents go in fresh worlds, and where random ones go in the same worlds."""

    run: LoadedRun
    seed: int
    greedy: bool
    episodes: int
    """Of each replica."""
    replicas: tuple[int, ...]
    """Their indices in the run, R of them, as in the arrays of `Stays`."""
    trained: Stays = field(repr=False)
    random: Stays = field(repr=False)

    def of(self, policy: Policy) -> Stays:
        """The stays of the run's agents or of random ones.

        Raises:
            ValueError: if the policy is neither "trained" nor "random".
        """
        arguments.choice("policy", policy, POLICIES)
        return self.trained if policy == "trained" else self.random


def territory_of(
    run: str | Path | LoadedRun,
    *,
    episodes: int = 20,
    greedy: bool = False,
    seed: int = SEED,
    replicas: Sequence[int] = (),
    allow: Sequence[str] = (),
) -> Territory:
    """Plays fresh episodes with every replica of a stored run, and with random agents in the same worlds.

    The episodes are those of `cprl.evaluate_run` with the same arguments.

    Args:
        run: its directory, its exported results, or a value of `cprl.load`.
        episodes: episodes of each replica, each in its own world.
        greedy: whether agents take their best action; else they explore as in evaluation.
        seed: the seed of the worlds and of all random numbers.
        replicas: the indices of the replicas that play; by default all.
        allow: see `cprl.load`.

    Raises:
        ValueError: for what `cprl.evaluate_run` refuses, and for a game without a board of cprl.
    """
    loaded = opened(run, allow)
    check(episodes=episodes, seed=seed, greedy=greedy, runs=[loaded])
    if not isinstance(loaded.game, Game):
        raise ValueError(f"{loaded.path} plays a game without a board of cprl; allowed: a run of a cprl.Game")
    numbers = chosen_replicas({str(loaded.path): loaded}, replicas)
    agents = partial(policies_of, [Source(loaded)] * loaded.game.agents, worlds=episodes, seed=seed)
    by_chance = partial(random_policies, loaded, worlds=episodes, seed=seed)
    how: dict[str, Any] = {"episodes": episodes, "seed": seed}
    return Territory(
        run=loaded,
        greedy=greedy,
        replicas=tuple(numbers),
        trained=_stays(loaded, agents, numbers, explore=not greedy, **how),
        random=_stays(loaded, by_chance, numbers, explore=True, **how),
        **how,
    )


def _stays(
    run: LoadedRun,
    who: Callable[[Sequence[int]], AgentPolicies],
    replicas: Sequence[int],
    *,
    episodes: int,
    seed: int,
    explore: bool,
) -> Stays:
    found: list[dict[str, Any]] = []
    for group, env in fresh_worlds(run, replicas, worlds=episodes, seed=seed):
        played = trace(env, who(group), explore=explore)
        firsts = range(0, len(group) * episodes, episodes)
        found += [_of_replica(_worlds(played, first, first + episodes)) for first in firsts]
    stacked = {name: np.stack([own[name] for own in found]) for name in found[0]}
    arrays = {name: stacked.pop(name) for name in ("visits", "taggings", "tagged_where")}
    return Stays(**arrays, by_replica=stacked)


def _worlds(played: Trace, first: int, end: int) -> Trace:
    """The trace of some of its worlds, from `first` on and without `end`."""
    tags = played.tags[(played.tags[:, 1] >= first) & (played.tags[:, 1] < end)]
    arrays = {name: getattr(played, name)[:, first:end] for name in _OF_WORLDS}
    return Trace(**arrays, board=played.board, tags=tags - np.array([0, first, 0, 0]))


_OF_WORLDS: Final = ("row", "col", "in_play", "fired", "played")


def _of_replica(played: Trace) -> dict[str, Any]:
    """The arrays and measures of the worlds of one replica."""
    shares = visits(played).mean(0)  # every agent is in play as an episode begins
    taggings = territory.taggings(played)
    tags = taggings.sum((1, 2))
    driven_out = np.where(tags > 0, territory.defence(played, shares), 0.0)
    with np.errstate(invalid="ignore"):
        defence = (driven_out * tags).sum() / np.float64(tags.sum())
    return {
        "visits": shares,
        "taggings": taggings.sum(0),
        "tagged_where": territory.tagged_where(played).sum(0),
        EXCLUSION: territory.exclusion(shares),
        VISITORS: territory.visitors(shares),
        OVERLAP: overlap(played).mean(),
        TAGS: 1000 * tags.sum() / played.played.sum(),
        DEFENCE: defence,
    }
