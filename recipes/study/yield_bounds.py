"""yield_bounds: how many apples a turn a board can bear, proven from below and from above.

In a turn that begins with a stock s, a site k without an apple grows one with the probability p of the number
of apples near it. So no policy gets more in the long run than the largest growth of any stock,

    max over s of  sum over k empty in s of  p(apples of s near k).

The same stock tells how to harvest: take each apple as soon as it grows, and nothing else, and s stays.
Where apples grow before bites, also under agents, this gives all that grows, so that both bounds meet if p
never falls with the number of apples; else a harvested site is full in the turn in which it is bitten, and
gives p / (1 + p) instead of p. The stock is found by integer programming (HiGHS, by scipy), whose own bound
is a proof, too, where the search is stopped early.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cprl.commons.maps import Map
from cprl.commons.near import bites_at_once, growth, kept_rates, patches, sites_around
from cprl.commons.rules import Rules
from cprl.commons.yields import check_proven

NODES: Final = 500
"""Of the search in each patch of sites, by default: enough for a proof on those of all published boards."""
_EXACT: Final = 1e-7

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class YieldBounds:
    """Apples a turn that all agents together can harvest for ever, wherever they are."""

    at_least: float
    at_most: float
    stock: NDArray[np.bool_]
    """bool [K], a stock to keep: who harvests all other sites as soon as they grow gets `at_least`."""

    @property
    def is_exact(self) -> bool:
        """Whether both bounds are the same, but for rounding."""
        return self.at_most - self.at_least < _EXACT


def yield_bounds(board: Map, rules: Rules, *, nodes: int = NODES) -> YieldBounds:
    """What a board bears, from below and from above.

    Ways, clashes and beams are left out, so that agents may get less than `at_least`; none get more than
    `at_most` in the long run, nor on average in an episode of T turns more than the first stock and
    T x `at_most`.

    Args:
        nodes: how long the search goes on: more bring the bounds together. The result follows from it alone,
            not from the machine's speed.
    """
    if board.river:
        raise ValueError(
            f"Map.river has {len(board.river)} cells, whose waste keeps apples from growing; allowed: a map "
            "without a river"
        )
    check_proven(rules)
    around = sites_around(board, rules)
    of_site, rows = growth(rules, np.array(list(map(len, around)), np.int32))
    probs = np.broadcast_to(rows[of_site], (len(around), rows.shape[1]))
    highest = np.maximum.accumulate(probs, 1)
    kept_rate = kept_rates(rules, probs)
    stock, bound = _best_stock(around, kept_rate, nodes)
    if not np.array_equal(kept_rate, highest):
        _, bound = _best_stock(around, highest, nodes)
    # A stock that is kept has the growth of its own counts, also where more apples near mean less.
    at_least = _growth(stock, around, probs if bites_at_once(rules) else kept_rate)
    return YieldBounds(at_least=at_least, at_most=max(bound, at_least), stock=stock)


def _growth(stock: NDArray[np.bool_], around: list[NDArray[np.int64]], rate: Floats) -> float:
    """The sum over empty sites of their rate by the number of full ones near them; `rate`: [K, counts]."""
    return float(sum(rate[site, stock[around[site]].sum()] for site in np.flatnonzero(~stock)))


def _best_stock(around: list[NDArray[np.int64]], rate: Floats, nodes: int) -> tuple[NDArray[np.bool_], float]:
    """The stock with the largest growth that is found, and a bound that no stock exceeds; each patch of sites
    that are near each other, directly or by others, is searched by itself."""
    patch_of = patches(around)
    stock, bound = np.zeros(len(around), np.bool_), 0.0
    for patch in range(patch_of.max() + 1):
        sites = np.flatnonzero(patch_of == patch)
        around_patch = [np.searchsorted(sites, around[site]) for site in sites]
        stock[sites], most = _best_of_patch(around_patch, rate[sites], nodes)
        bound += most
    return stock, bound


def _best_of_patch(
    around: list[NDArray[np.int64]], rate: Floats, nodes: int
) -> tuple[NDArray[np.bool_], float]:
    """`_best_stock` of one patch, by integer programming.

    x_k says that site k is full, z_km that it is empty with m or more full sites near, for each m at which
    its rate rises: the growth is the sum of the rises.
    """
    from scipy.optimize import Bounds, LinearConstraint, milp
    from scipy.sparse import csr_array

    sites, rises = len(around), np.diff(rate, axis=1)
    steps = [
        (site, count + 1)
        for site, near in enumerate(around)
        for count in np.flatnonzero(rises[site, : len(near)]).tolist()
    ]
    gain = np.array([*-rate[:, 0], *(rises[site, count - 1] for site, count in steps)])
    if not gain.any():
        return np.zeros(sites, np.bool_), 0.0
    cells: dict[tuple[int, int], float] = {}
    for step, (site, count) in enumerate(steps):
        unless_full, where_near = 2 * step, 2 * step + 1
        cells |= {
            (unless_full, sites + step): 1.0,
            (unless_full, site): 1.0,
            (where_near, sites + step): count,
        }
        cells |= {(where_near, int(other)): -1.0 for other in around[site]}
    rows, columns = np.array(list(cells), np.int64).reshape(-1, 2).T
    matrix = csr_array((list(cells.values()), (rows, columns)), shape=(2 * len(steps), len(gain)))
    best = milp(
        -gain,
        constraints=LinearConstraint(matrix, ub=np.tile([1.0, 0.0], len(steps))) if steps else (),
        integrality=np.ones(len(gain)),
        bounds=Bounds(0, 1),
        options={"node_limit": nodes},
    )
    if best.x is None:
        raise RuntimeError(f"no stock was found in {nodes:,} nodes; allowed: more nodes")
    return best.x[:sites] > 0.5, float(rate[:, 0].sum()) - float(best.mip_dual_bound)
