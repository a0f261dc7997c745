"""play_empirical_game: the game whose strategies are stored runs, and whose payoffs are their returns.

Each agent plays as a run, i.e. as the run's agent with its index. For N agents and S runs every composition
is played, so many agents of one run and so many of the next: C = (N + S - 1)! / (N! (S - 1)!). A composition
of several runs is played N times, with the agents of the first run from index s on, cyclically, then those of
the second and so on, for each s, so that each run has each index as often as every other index. Replica r is
that of all runs, in the same worlds for all compositions; agents of one run learned together.

`pairwise_game` makes a game of two agents of what `crossplay` played, the payoffs of one focal agent by its
run and that of the background agents. For N = 2 it is the same game. For more agents it is a reduction that
knows what the first agent gains who deviates from the run of all others, and nothing of mixes; its equilibria
in which one run is played are those of the whole game, the others need not be.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from cprl.evaluation.cross_play import CrossPlay, named_runs
from cprl.evaluation.evaluate import SEED, check_same_game, fresh_episodes
from cprl.evaluation.lanes import Fresh, Played, Source
from cprl.measuring.episodes import Episode
from cprl.runs.episodes import labelled
from cprl.theory.payoff_table import PayoffTable, compositions
from cprl.theory.solutions import MOST_PROFILES
from cprl.training.agents import LoadedRun

Values = NDArray[np.float64]
Who = tuple[int, ...]
"""Which run each agent plays as."""


@dataclass(frozen=True, kw_only=True, eq=False)
class EmpiricalGame:
    """A game of N agents whose strategies are S runs; see the docstring of this module."""

    runs: Mapping[str, LoadedRun]
    """The S runs by name."""
    agents: int
    """N of this game: 2 of a pairwise one."""
    of_agents: int
    """The agents of the game that was played."""
    payoffs: Values
    """float64 [R, C, S]: the mean return of an agent of a run by replica and composition, in the rows of
    `cprl.theory.compositions(agents, S)`; NaN where nobody plays as the run."""
    fresh: Fresh
    episodes_table: pa.Table
    """All episodes with the columns of `episodes.parquet`, after those that say who played: "runs", the
    names of all agents' runs, or those of `CrossPlay.table`."""

    def __repr__(self) -> str:
        return f"EmpiricalGame({', '.join(self.runs)}; {self.agents} agents, {self.fresh})"

    @property
    def names(self) -> list[str]:
        return list(self.runs)

    @property
    def is_reduction(self) -> bool:
        """Whether more agents played than this game has."""
        return self.agents < self.of_agents

    def table(self, replicas: Sequence[int] | None = None) -> PayoffTable:
        """The mean payoffs over replicas.

        Args:
            replicas: their places in `payoffs`, e.g. a resample; by default all once.
        """
        places = list(range(len(self.payoffs)) if replicas is None else replicas)
        if not places:
            raise ValueError("replicas is empty; allowed: at least one place")
        return PayoffTable(agents=self.agents, payoffs=self.payoffs[places].mean(0))


def play_empirical_game(
    runs: Sequence[str | Path | LoadedRun] | Mapping[str, str | Path | LoadedRun],
    *,
    episodes: int = 5,
    greedy: bool = False,
    seed: int = SEED,
    replicas: Sequence[int] = (),
    allow: Sequence[str] = (),
) -> EmpiricalGame:
    """Plays all compositions of runs.

    Args:
        runs: at least two runs of the same game, as for `crossplay`. With S runs and N agents up to 256
            profiles S^N are allowed, e.g. four runs of four agents; `pairwise_game` has no such bound.
        episodes: episodes of each replica and choice of who plays where, each in its own world; the choices
            are N (C - S) + S.
    """
    named = named_runs(runs, allow, command="egta")
    check_same_game(named)
    agents = next(iter(named.values())).game.agents
    if agents < 2:
        raise ValueError("the game has 1 agent; allowed for an empirical game: at least 2")
    if (profiles := len(named) ** agents) > MOST_PROFILES:
        raise ValueError(
            f"{len(named)} runs of {agents} agents have {profiles:,} profiles; allowed: at most "
            f"{MOST_PROFILES}; crossplay and pairwise_game (cprl egta --pairwise) take more"
        )
    fresh = fresh_episodes(named.values(), episodes=episodes, greedy=greedy, seed=seed, replicas=replicas)
    counts = compositions(agents, len(named))
    played = {}
    for composition in counts.tolist():
        for who in _choices(composition):
            sources = [Source(list(named.values())[run]) for run in who]
            played[who] = fresh.play(sources[0].run, fresh.agents(sources))
    return EmpiricalGame(
        runs=named,
        agents=agents,
        of_agents=agents,
        payoffs=np.array(
            [
                [_payoffs(composition, played, replica) for composition in counts.tolist()]
                for replica in fresh.replicas
            ]
        ),
        fresh=fresh,
        episodes_table=labelled(_rows(list(named), played)),
    )


def pairwise_game(played: CrossPlay) -> EmpiricalGame:
    """The game of two agents that a cross-play makes; see the docstring of this module.

    Args:
        played: the cross-play; its `diagonal` says who plays where both play as one run.
    """
    names = list(played.runs)
    returns = {at: cell.returns("focal") for at, cell in played.cells.items()}
    matrices = [
        [[np.mean(returns[focal, background][replica]) for background in names] for focal in names]
        for replica in played.fresh.replicas
    ]
    return EmpiricalGame(
        runs=played.runs,
        agents=2,
        of_agents=next(iter(played.runs.values())).game.agents,
        payoffs=np.array([PayoffTable.of_pairs(matrix).payoffs for matrix in matrices]),
        fresh=played.fresh,
        episodes_table=played.table(),
    )


def _choices(counts: Sequence[int]) -> list[Who]:
    """Who plays at which index, for each of N shifts; of one run alone the one way."""
    first = tuple(int(run) for run in np.repeat(np.arange(len(counts)), counts))
    shifts = len(first) if len(set(first)) > 1 else 1
    return [(*first[-shift:], *first[:-shift]) if shift else first for shift in range(shifts)]


def _payoffs(counts: Sequence[int], played: Mapping[Who, Played], replica: int) -> list[float]:
    """The mean return of an agent of each run, [S]; NaN for a run that does not play."""
    returns: list[list[float]] = [[] for _ in counts]
    for who in _choices(counts):
        for episode in played[who][replica]:
            for run, return_ in zip(who, episode.return_, strict=True):
                returns[run].append(float(return_))
    return [float(np.mean(of_run)) if of_run else float("nan") for of_run in returns]


def _rows(
    names: Sequence[str], played: Mapping[Who, Played]
) -> Iterator[tuple[dict[str, str], int, list[Episode]]]:
    for who, by_replica in played.items():
        for replica, episodes in by_replica.items():
            yield {"runs": " ".join(names[run] for run in who)}, replica, episodes
