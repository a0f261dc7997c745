"""PayoffTable: a symmetric game of N agents with a few strategies, by how many agents play each.

What an agent gets depends on its own strategy and on how many of the others play each, not on who they are.
So N agents with S strategies need a row for each of the C = (N + S - 1)! / (N! (S - 1)!) compositions, not
one for each of the S^N profiles. Empirical games, whose strategies are stored policies and whose payoffs are
measured, are given in this way.

Source: W. E. Walsh, R. Das, G. Tesauro and J. O. Kephart, "Analyzing Complex Strategic Interactions in
Multi-Agent Systems" (2002); for the reduction to pairs, of which it is the case of two agents, M. P. Wellman,
"Methods for Empirical Game-Theoretic Analysis" (2006).
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from math import comb, factorial, prod
from typing import Annotated, Final, Self

import numpy as np
from numpy.typing import ArrayLike

from cprl.values import Range, checked, refusal
from cprl.values.array_types import Float64, Int64

MOST_COMPOSITIONS: Final = 100_000
_SUM: Final = 1e-6
"""The difference from 1 that the shares of a mixture may have together."""
_ROUNDING: Final = 1e-9
"""The rounding of payoffs, as a share of their range."""


def compositions(agents: int, strategies: int) -> Int64:
    """Return how many of N agents play each of S strategies, int64 [C, S], every way once; the first row has
    all of them play strategy 0, the last one the last strategy."""
    rows = comb(agents + strategies - 1, agents)
    if rows > MOST_COMPOSITIONS:
        raise ValueError(
            f"{agents} agents with {strategies} strategies have {rows:,} compositions; allowed: at most "
            f"{MOST_COMPOSITIONS:,}"
        )
    places = combinations(range(agents + strategies - 1), strategies - 1)  # of bars among agents
    bars = np.array(list(places), dtype=np.int64).reshape(rows, strategies - 1)
    ends = np.pad(bars, ((0, 0), (1, 1)), constant_values=((0, 0), (-1, agents + strategies - 1)))
    return np.ascontiguousarray((np.diff(ends, axis=1) - 1)[::-1])


@dataclass(frozen=True, kw_only=True, eq=False)
class PayoffTable:
    """What agents get by how many play each strategy; see the docstring of this module."""

    agents: int
    """The number of agents N, at least 2."""
    payoffs: Float64
    """float64 [C, S], in units of one's own: what an agent gets who plays a strategy, for each row of
    `counts`; finite where somebody plays it, elsewhere whatever is given becomes NaN."""

    def __post_init__(self) -> None:
        agents = checked("agents", self.agents, Annotated[int, Range(2, 1000)])
        payoffs = np.asarray(self.payoffs, np.float64)
        strategies = payoffs.shape[1] if payoffs.ndim == 2 else 0
        rows = comb(agents + strategies - 1, agents) if strategies > 1 else 0
        if strategies < 2 or len(payoffs) != rows:
            allowed = f"[{rows}, {strategies}]" if rows else "[C, S], of 2 or more strategies"
            raise ValueError(f"payoffs is {list(payoffs.shape)}; allowed with {agents} agents: {allowed}")
        counts = compositions(agents, strategies)
        payoffs = np.where(counts > 0, payoffs, np.nan)
        if not np.isfinite(payoffs[counts > 0]).all():
            raise ValueError("payoffs has NaN or infinity where agents play; allowed: finite numbers")
        object.__setattr__(self, "agents", agents)
        object.__setattr__(self, "payoffs", payoffs)

    @classmethod
    def from_pairs(cls, matrix: ArrayLike) -> Self:
        """Return the game of two agents: entry [i, j] is what one gets who plays i, where the other plays
        j."""
        payoffs = np.asarray(matrix, np.float64)
        if payoffs.ndim != 2 or payoffs.shape[0] != payoffs.shape[1] or len(payoffs) < 2:
            raise ValueError(f"matrix is {list(payoffs.shape)}; allowed: [S, S], of 2 or more strategies")
        counts = compositions(2, len(payoffs))
        other = counts[:, None, :] - np.eye(len(payoffs), dtype=np.int64)  # [C, own strategy, the other's]
        return cls(agents=2, payoffs=(other * payoffs).sum(-1))

    @property
    def strategies(self) -> int:
        """Return the number of strategies S."""
        return int(self.payoffs.shape[1])

    @cached_property
    def counts(self) -> Int64:
        """Return how many agents play each strategy, int64 [C, S]."""
        return compositions(self.agents, self.strategies)

    @cached_property
    def rows(self) -> dict[tuple[int, ...], int]:
        """Return the number of each row by its counts."""
        return {tuple(counts): row for row, counts in enumerate(self.counts.tolist())}

    @cached_property
    def deviations(self) -> Float64:
        """Return what an agent gets who plays a strategy, float64 [C', S], by how many of the other N - 1
        play each, in the rows of `compositions(N - 1, S)`."""
        rows = []
        for others in self._others[0]:
            rows.append([self.rows[counts] for counts in self._with_one_more(others)])
        values: Float64 = self.payoffs[rows, np.arange(self.strategies)]
        return values

    @cached_property
    def pairs(self) -> Float64:
        """Return what one agent gets who plays i, where all others play j, float64 [S, S]."""
        others, _ = self._others
        alike = [int(others[:, strategy].argmax()) for strategy in range(self.strategies)]
        return self.deviations[alike].T.copy()

    @property
    def reduced(self) -> "PayoffTable":
        """Return the game of two agents with the payoffs of `pairs`, a reduction unless N is 2: it says what
        the first agent gains who deviates from what all others play, and nothing of other compositions."""
        return self.from_pairs(self.pairs)

    @cached_property
    def normalised(self) -> "PayoffTable":
        """Return the same game with payoffs from 0 to 1; all 0 where they are all the same."""
        low = float(np.nanmin(self.payoffs))
        range_of_payoffs = float(np.nanmax(self.payoffs)) - low
        return PayoffTable(agents=self.agents, payoffs=(self.payoffs - low) / (range_of_payoffs or 1.0))

    def against(self, mixture: ArrayLike) -> Float64:
        """Return what an agent gets by its strategy, float64 [S], if each of the others plays one by chance.

        It is the mean over what the N - 1 others play, so it is also defined for strategies that nobody
        plays. (OpenSpiel's `expected_payoff` of a heuristic payoff table is another number: the mean over
        the compositions of all N agents in which the strategy occurs, as in K. Tuyls et al. (2018).)
        """
        return self.against_shares(mixture_of(mixture, self.strategies))

    def against_shares(self, shares: Float64) -> Float64:
        """Return what `against` does, of float64 [S] that is known to be shares."""
        others, ways = self._others
        values: Float64 = (ways * np.prod(shares**others, axis=1)) @ self.deviations
        return values

    @cached_property
    def _others(self) -> tuple[Int64, Float64]:
        """Return what the N - 1 others may play, and in how many ways, [C', S] and [C']."""
        others = compositions(self.agents - 1, self.strategies)
        ways = [factorial(self.agents - 1) // prod(map(factorial, counts)) for counts in others.tolist()]
        return others, np.array(ways, np.float64)

    @property
    def pure_equilibria(self) -> list[tuple[int, ...]]:
        """Return the counts of the compositions in which no agent gains if it alone plays another strategy,
        but for rounding."""
        most = _ROUNDING * float(np.nanmax(self.payoffs) - np.nanmin(self.payoffs))
        left = {
            counts
            for others, payoffs in zip(self._others[0], self.deviations, strict=True)
            for counts, payoff in zip(self._with_one_more(others), payoffs, strict=True)
            if payoffs.max() - payoff > most
        }
        return [counts for counts in self.rows if counts not in left]

    def _with_one_more(self, others: Int64) -> list[tuple[int, ...]]:
        """Return the counts if one more agent plays each strategy in turn."""
        return list(map(tuple, (others + np.eye(self.strategies, dtype=np.int64)).tolist()))


def mixture_of(mixture: ArrayLike, strategies: int) -> Float64:
    """Return a mixture as shares of strategies, float64 [S], that sum to 1; refuse any other."""
    shares = np.asarray(mixture, np.float64)
    is_mixture = shares.shape == (strategies,) and (shares >= 0).all() and abs(shares.sum() - 1) < _SUM
    if not is_mixture:
        allowed = f"[{strategies}] of shares from 0 to 1 that sum to 1"
        raise refusal("mixture", shares.tolist(), allowed)
    return shares
