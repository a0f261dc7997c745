"""How many apples a turn can a board bear? `yield_bounds`, proven from below and from above.

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

from cprl.commons.maps import Map
from cprl.commons.near import growth_probs, harvest_rates, harvests_at_once, patches, sites_around
from cprl.commons.rules import Rules
from cprl.commons.yields import check_proven
from cprl.values.array_types import Bool, Float64, Int64

NODES: Final = 500
"""The nodes of the search in each patch of sites, by default: enough for a proof on all published boards."""
_EXACT: Final = 1e-7


@dataclass(frozen=True, kw_only=True, eq=False)
class YieldBounds:
    """Apples a turn that all agents together can harvest for ever, wherever they are."""

    at_least: float
    at_most: float
    stock: Bool
    """bool [K], a stock to keep: who harvests all other sites as soon as they grow gets `at_least`."""

    @property
    def is_exact(self) -> bool:
        """Return whether both bounds are the same, but for rounding."""
        return self.at_most - self.at_least < _EXACT


def yield_bounds(board: Map, rules: Rules, *, nodes: int = NODES) -> YieldBounds:
    """Return what a board bears, from below and from above.

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
    site_row, rows = growth_probs(rules, np.array(list(map(len, around)), np.int32))
    probs = np.broadcast_to(rows[site_row], (len(around), rows.shape[1]))
    highest = np.maximum.accumulate(probs, 1)
    kept_rate = harvest_rates(rules, probs)
    stock, bound = _best_stock(around, kept_rate, nodes)
    if not np.array_equal(kept_rate, highest):
        _, bound = _best_stock(around, highest, nodes)
    # A stock that is kept has the growth of its own counts, also where more apples near mean less.
    rate = probs if harvests_at_once(rules) else kept_rate
    at_least = _growth(stock, around, rate)
    return YieldBounds(at_least=at_least, at_most=max(bound, at_least), stock=stock)


def _growth(stock: Bool, around: list[Int64], rate: Float64) -> float:
    """Return the sum over empty sites of their rate, [K, counts], by the number of full ones near them."""
    return float(sum(rate[site, stock[around[site]].sum()] for site in np.flatnonzero(~stock)))


def _best_stock(around: list[Int64], rate: Float64, nodes: int) -> tuple[Bool, float]:
    """Return the stock with the largest growth that is found, and a bound that no stock exceeds.

    Each patch of sites that are near each other, directly or by others, is searched by itself.
    """
    patch_of = patches(around)
    stock = np.zeros(len(around), np.bool_)
    bound = 0.0
    for patch in range(patch_of.max() + 1):
        sites = np.flatnonzero(patch_of == patch)
        around_patch = [np.searchsorted(sites, around[site]) for site in sites]
        stock[sites], most = _best_of_patch(around_patch, rate[sites], nodes)
        bound += most
    return stock, bound


def _best_of_patch(around: list[Int64], rate: Float64, nodes: int) -> tuple[Bool, float]:
    """Return `_best_stock` of one patch, by integer programming.

    x_k says that site k is full, z_km that it is empty with m or more full sites near, for each m at which
    its rate rises: the growth is the sum of the rises. A z_km is at most 1 - x_k, and m z_km at most the
    number of full sites near.
    """
    from scipy.optimize import Bounds, LinearConstraint, milp

    sites = len(around)
    rises = np.diff(rate, axis=1)
    steps = [(site, m) for site, near in enumerate(around) for m in np.flatnonzero(rises[site, : len(near)])]
    gain = np.array([*-rate[:, 0], *(rises[step] for step in steps)])
    if not gain.any():
        return np.zeros(sites, np.bool_), 0.0
    left = np.zeros((len(steps), 2, len(gain)))
    for number, (site, m) in enumerate(steps):
        left[number, 0, [site, sites + number]] = 1.0
        left[number, 1, sites + number] = m + 1
        left[number, 1, around[site]] = -1.0
    most = np.tile([1.0, 0.0], len(steps))
    constraints = [LinearConstraint(left.reshape(-1, len(gain)), ub=most)] if steps else []
    best = milp(
        -gain,
        constraints=constraints,
        integrality=np.ones(len(gain)),
        bounds=Bounds(0, 1),
        options={"node_limit": nodes},
    )
    if best.x is None:
        raise RuntimeError(f"no stock was found in {nodes:,} nodes; allowed: more nodes")
    return best.x[:sites] > 0.5, float(rate[:, 0].sum()) - float(best.mip_dual_bound)
