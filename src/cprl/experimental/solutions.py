"""What a payoff table amounts to: Nash equilibria by nashpy, alpha-rank and replicator dynamics by OpenSpiel.

Both packages come with the extra "theory", and are imported where they are used.

Alpha-rank: each of the N agents stands for a population that plays one strategy. Now and then a mutant turns
up in one of them, and takes it over the more probably, the more it gets beside what it replaces while the
other populations stay as they are. How often each composition is seen in the long run ranks the strategies.
Mutants are compared with those whose place they take, not with the other agents, so what lasts is what no
agent gains by leaving: compositions that are equilibria, or cycles around none.

Replicator dynamics: in one large population, agents meet by chance, N at a time; a strategy's share grows at
the rate at which it gets more than the mean.

Source: S. Omidshafiei et al., "Alpha-Rank: Multi-Agent Evaluation by Evolution" (2019), for several
populations; M. Rowland et al., "Multiagent Evaluation under Incomplete Information" (2019), for the limit of
infinite alpha.
"""

from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from cprl.experimental.payoff_table import PayoffTable, mixture_of
from cprl.values.array_types import Float64

_PACKAGES: Final = {"open_spiel": "alpha-rank and replicator dynamics", "nashpy": "equilibria"}
MOST_STRATEGIES: Final = 6
"""With more, nashpy takes minutes."""
_SAME: Final = 1e-6
"""Shares that differ by less are the same."""
MOST_PROFILES: Final = 256
"""S^N, e.g. 4 agents with 4 strategies; with more, OpenSpiel takes seconds."""
REPLICATOR_STARTS: Final = 40

_NOISES: Final = (1e-6, 1e-5, 1e-4, 1e-3)
_STEPS: Final = 1500
"""The number of steps of the integration, which are the longer the slower the shares change."""
_AT_REST: Final = 1e-6
_NO_GAIN: Final = 1e-5
"""The excess of a strategy over the mean at rest, as a share of the range of the payoffs."""
_SAME_END: Final = 0.01


@dataclass(frozen=True, kw_only=True, eq=False)
class Equilibrium:
    """What two agents play, so that neither gains if it alone plays anything else."""

    first: Float64
    """float64 [S], the shares of the strategies that one agent plays."""
    second: Float64
    """float64 [S], those of the other."""

    @property
    def is_symmetric(self) -> bool:
        """Return whether both play the same."""
        return bool(np.allclose(self.first, self.second, atol=_SAME))

    @property
    def support(self) -> tuple[int, ...]:
        """Return the strategies that an agent plays, ascending."""
        return tuple(np.flatnonzero((self.first > _SAME) | (self.second > _SAME)).tolist())


def equilibria(table: PayoffTable) -> tuple[Equilibrium, ...]:
    """Return the equilibria of a symmetric game of two agents, by nashpy's enumeration of vertices.

    They are all of them, unless the game is degenerate: where strategies are equally good, there may be
    infinitely many, and these are the corners. An equilibrium in which the agents play differently is there
    once, not once for either agent.

    Args:
        table: of two agents and up to 6 strategies; of a game of more agents its `reduced`.
    """
    if table.agents != 2:
        raise ValueError(f"table is of {table.agents} agents; allowed: 2, e.g. table.reduced")
    if table.strategies > MOST_STRATEGIES:
        raise ValueError(f"table has {table.strategies} strategies; allowed: at most {MOST_STRATEGIES}")
    nashpy = extra("nashpy")
    payoffs = table.normalised.pairs + 1.0  # above 0, or the polytopes have no end
    by_shares: dict[tuple[float, ...], Equilibrium] = {}
    for first, second in nashpy.Game(payoffs, payoffs.T).vertex_enumeration():
        sides = sorted((tuple(np.round(side, 6) + 0.0) for side in (first, second)), reverse=True)
        key = (*sides[0], *sides[1])
        by_shares.setdefault(key, Equilibrium(first=np.array(sides[0]), second=np.array(sides[1])))
    return tuple(by_shares[key] for key in sorted(by_shares, reverse=True))


@dataclass(frozen=True, kw_only=True, eq=False)
class AlphaRank:
    """How often compositions and strategies are seen in the long run."""

    compositions: Float64
    """float64 [C], of the rows of the table; sums to 1."""
    shares: Float64
    """float64 [S], the mean share of the agents that play a strategy; sums to 1."""


def alpha_rank(table: PayoffTable) -> AlphaRank:
    """Return alpha-rank of a symmetric game in the limit of infinite alpha, by OpenSpiel.

    Payoffs are first scaled to 0..1. A mutant takes over if it gets more, with probability 1/2 if it gets the
    same (to 1e-5 of what it gets), and else almost never; "almost" is 1e-6, or the next power of ten with
    which OpenSpiel can tell a single long run from several, up to 1e-3.

    Args:
        table: with at most 256 profiles S^N; of a larger game its `reduced`.
    """
    profiles = table.strategies**table.agents
    if profiles > MOST_PROFILES:
        raise ValueError(
            f"table has {table.strategies}^{table.agents} = {profiles:,} profiles; allowed: at most "
            f"{MOST_PROFILES}, e.g. table.reduced"
        )
    shares = _long_run(table)
    played = np.array(np.unravel_index(np.arange(profiles), (table.strategies,) * table.agents)).T
    frequencies = np.zeros(len(table.counts))
    for profile, share in zip(played, shares, strict=True):
        counts = np.bincount(profile, minlength=table.strategies)
        frequencies[table.rows[tuple(counts.tolist())]] += share
    return AlphaRank(compositions=frequencies, shares=frequencies @ table.counts / table.agents)


def _long_run(table: PayoffTable) -> Float64:
    """Return the share of each profile of N agents, [S^N], the last agent's strategy changing fastest."""
    rank = extra("open_spiel.python.egt.alpharank")
    tables = [_heuristic(table.normalised)] * table.agents
    for noise in _NOISES:
        try:
            return _shares(rank.compute(tables, use_inf_alpha=True, inf_alpha_eps=noise)[2])
        except ValueError as error:
            last = error
    raise last


def _shares(measured: Any) -> Float64:
    shares: Float64 = np.maximum(np.asarray(measured, dtype=np.float64), 0.0)
    whole: Float64 = shares / shares.sum()
    return whole


def _heuristic(table: PayoffTable) -> Any:
    """Return the table as OpenSpiel has it, 0 where nobody plays."""
    module = extra("open_spiel.python.egt.heuristic_payoff_table")
    heuristic = module.PayoffTable(table.agents, table.strategies)
    for counts, payoffs in zip(table.counts.tolist(), np.nan_to_num(table.payoffs), strict=True):
        heuristic[tuple(counts)] = payoffs
    return heuristic


def replicator(table: PayoffTable, mixture: ArrayLike) -> Float64:
    """Return how fast the shares of the strategies change, float64 [S], which sums to 0: by OpenSpiel.

    Args:
        mixture: the shares, float [S], that sum to 1.
    """
    shares = mixture_of(mixture, table.strategies)
    flow = extra("open_spiel.python.egt.dynamics").replicator(shares, table.against(shares))
    return np.asarray(flow, dtype=np.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class Ends:
    """The ends of replicator dynamics."""

    mixtures: Float64
    """float64 [K, S], the fixed points that were reached, the most frequent first."""
    shares: Float64
    """float64 [K], of the starts that end there."""
    unsettled: float
    """The share of the starts that go on for ever, or for very long."""


def replicator_ends(table: PayoffTable, *, starts: int = REPLICATOR_STARTS, seed: int = 0) -> Ends:
    """Return the ends of replicator dynamics that start anywhere, with all shares above 0.

    Args:
        starts: so many mixtures, drawn uniformly.
    """
    rng = np.random.default_rng(seed)
    reached = [_end(table, mixture) for mixture in rng.dirichlet(np.ones(table.strategies), starts)]
    settled = [mixture for mixture in reached if mixture is not None]
    groups: list[list[Float64]] = []
    for mixture in settled:
        near = [group for group in groups if np.abs(group[0] - mixture).max() < _SAME_END]
        if near:
            near[0].append(mixture)
        else:
            groups.append([mixture])
    groups.sort(key=len, reverse=True)
    return Ends(
        mixtures=np.array([np.mean(group, axis=0) for group in groups]).reshape(-1, table.strategies),
        shares=np.array([len(group) / starts for group in groups]),
        unsettled=1 - len(settled) / starts,
    )


def _end(table: PayoffTable, start: Float64) -> Float64 | None:
    """Return the end of the dynamics, or None if they are not at rest after a long time.

    Shares hardly change where a strategy that gets more is rare, too; that is no rest.
    """
    from scipy import integrate

    scaled = table.normalised
    flow = extra("open_spiel.python.egt.dynamics").replicator

    def speed(_: float, cells: Float64) -> Float64:
        shares = _shares(cells)
        return np.asarray(flow(shares, scaled.against_shares(shares)), dtype=np.float64)

    def is_at_rest(cells: Float64) -> bool:
        shares = _shares(cells)
        payoffs = scaled.against_shares(shares)
        gains = payoffs - shares @ payoffs
        return bool(np.abs(shares * gains).max() <= _AT_REST and gains.max() <= _NO_GAIN)

    solver = integrate.LSODA(speed, 0.0, start, np.inf, rtol=1e-4, atol=1e-8)
    for _ in range(_STEPS):
        if is_at_rest(solver.y):
            return _shares(solver.y)
        if solver.status != "running":
            return None
        solver.step()
    return None


def check_extras() -> None:
    """Raise a ModuleNotFoundError, which says how to install it, if OpenSpiel or nashpy is missing."""
    for package in _PACKAGES:
        extra(package)


def extra(module: str) -> Any:
    """Import and return a module of OpenSpiel or nashpy."""
    package = module.partition(".")[0]
    if find_spec(package) is None:
        raise ModuleNotFoundError(
            f'{_PACKAGES[package]} need {package}, which is not installed; run pip install "cprl[theory]"'
        )
    return import_module(module)
