"""analyse: what an empirical game amounts to, with what replicas leave open.

The means over replicas are one game; alpha-rank, the equilibria and the replicator dynamics are those of this
game. Only replicas are independent, so the bootstrap draws as many replicas with replacement, the same ones
for all payoffs, and analyses the game of their means anew: the interval of a run's share is that between the
2.5 and the 97.5 per cent quantiles, and an equilibrium is as certain as the share of these games that have
it. With few replicas such intervals are too narrow rather than too wide.
"""

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from cprl import arguments
from cprl.evaluation.empirical_game import EmpiricalGame
from cprl.measuring.statistics import CONFIDENCE, Estimate
from cprl.theory.equilibria import MOST_STRATEGIES, Equilibrium, equilibria
from cprl.theory.evolution import AlphaRank, Ends, alpha_rank, replicator_ends
from cprl.theory.payoff_table import PayoffTable, Values


@dataclass(frozen=True, kw_only=True, eq=False)
class Analysis:
    """What an empirical game amounts to; see the docstring of this module."""

    game: EmpiricalGame
    table: PayoffTable = field(repr=False)
    """The means over replicas."""
    resamples: int
    """Of the bootstrap; 0 for a single replica."""
    rank: AlphaRank = field(repr=False)
    shares: tuple[Estimate, ...]
    """The share of the agents that play as each run in the long run of alpha-rank, with its interval."""
    pure: dict[tuple[int, ...], float] = field(repr=False)
    """The compositions in which no agent gains by playing as another run, by the number of agents of each
    run, with the share of the resamples that have it too; NaN for a single replica."""
    equilibria: tuple[Equilibrium, ...]
    """By nashpy, of a game of two agents, of a larger one of its reduction; empty for more than 6 runs."""
    in_support: Values = field(repr=False)
    """float64 [S]: the share of the resamples in which a run is played in a symmetric equilibrium of two
    agents; NaN for a single replica, more than 6 runs, and for a game of more agents."""
    ends: Ends = field(repr=False)
    """Where replicator dynamics end."""


def analyse(game: EmpiricalGame, *, resamples: int = arguments.EGTA_RESAMPLES, seed: int = 0) -> Analysis:
    """Analyses an empirical game.

    Args:
        game: of `play_empirical_game` or `pairwise_game`.
        resamples: the number of bootstrap resamples of the replicas.
        seed: the seed of the resampling, and of the starts of the replicator dynamics.

    Raises:
        ValueError: for numbers out of range, and see `cprl.theory.alpha_rank`.
        ModuleNotFoundError: if OpenSpiel or nashpy is not installed.
    """
    arguments.object_of("game", game, EmpiricalGame, "what play_empirical_game() or pairwise_game() gave")
    resamples = arguments.integer("resamples", resamples, 1, 100_000)
    rng, replicas = np.random.default_rng(arguments.seed(seed)), len(game.payoffs)
    table = game.table()
    drawn = rng.integers(replicas, size=(resamples if replicas > 1 else 0, replicas))
    # Few replicas have few resamples that differ: each is analysed once.
    times = Counter(tuple(sorted(own)) for own in drawn.tolist())
    again = [(game.table(own), count) for own, count in times.items()]
    rank = alpha_rank(table)
    return Analysis(
        game=game,
        table=table,
        resamples=len(drawn),
        rank=rank,
        shares=_shares(rank, again, replicas),
        pure=_certainty(table, again),
        equilibria=_equilibria(table.reduced),
        in_support=_in_support(table, again),
        ends=replicator_ends(table, seed=seed),
    )


def _shares(rank: AlphaRank, again: list[tuple[PayoffTable, int]], replicas: int) -> tuple[Estimate, ...]:
    bounds = np.full((2, len(rank.shares)), np.nan)
    if again:
        found = [np.tile(alpha_rank(own).shares, (count, 1)) for own, count in again]
        margin = (1 - CONFIDENCE) / 2
        bounds = np.quantile(np.concatenate(found), [margin, 1 - margin], axis=0)
    return tuple(
        Estimate(value=float(share), low=float(low), high=float(high), replicas=replicas)
        for share, low, high in zip(rank.shares, *bounds, strict=True)
    )


def _certainty(table: PayoffTable, again: list[tuple[PayoffTable, int]]) -> dict[tuple[int, ...], float]:
    found: Counter[tuple[int, ...]] = Counter()
    for own, count in again:
        for counts in own.pure_equilibria:
            found[counts] += count
    total = sum(count for _, count in again)
    return {counts: found[counts] / total if total else float("nan") for counts in table.pure_equilibria}


def _equilibria(table: PayoffTable) -> tuple[Equilibrium, ...]:
    return equilibria(table) if table.strategies <= MOST_STRATEGIES else ()


def _in_support(table: PayoffTable, again: list[tuple[PayoffTable, int]]) -> Values:
    """See `Analysis.in_support`."""
    shares = np.zeros(table.strategies)
    if not again or table.agents > 2 or table.strategies > MOST_STRATEGIES:
        return np.full(table.strategies, np.nan)
    for own, count in again:
        symmetric = [found for found in equilibria(own) if found.is_symmetric]
        shares[sorted({run for found in symmetric for run in found.support})] += count
    return shares / sum(count for _, count in again)
