"""What a map can bear: a proven lower bound of its sustainable yield."""

import numpy as np
from numpy.typing import NDArray

from cprl.commons.maps import Map
from cprl.commons.near import growth, kept_rates, sites_around
from cprl.commons.rules import Rules


def sustainable_yield(board: Map, rules: Rules) -> float:
    """Apples per turn that can be harvested for ever: a lower bound, proven by a way to reach it.

    Some sites are harvested as soon as they hold an apple, the others never. A harvested site with m
    unharvested sites near it then grows an apple in every turn in which it is empty with at least the
    probability p = min(`regrow_prob`[m:]). So it bears p / (1 + p) apples a turn: it stands full for the turn
    in which it is bitten, except under `regrow_before_bites` with `regrow_under_agents`, where it bears p.
    Which sites are harvested is found by a greedy search, so more may be possible. An isolated cross under
    the published probabilities has two harvested sites with three apples near each: 0.1 apples a turn as run.

    On a map with a river it is the yield of a clean river, and no bound otherwise.
    """
    around = sites_around(board, rules)
    of_site, probs = growth(rules, np.array([len(some) for some in around], np.int32))
    rates = kept_rates(rules, probs)
    return _best(np.broadcast_to(rates[of_site], (len(around), rates.shape[1])), around)


def _best(rate: NDArray[np.float64], around: list[NDArray[np.int64]]) -> float:
    """The yield of the harvested sites that a greedy search finds: each added while the sum grows.

    `rate`: [K, counts], what a site bears with so many unharvested sites near it."""
    sites = len(around)
    others = np.array([len(some) for some in around])
    harvested = np.zeros(sites, np.bool_)

    def gain(k: int) -> float:
        hurt = around[k][harvested[around[k]]]
        return float(rate[k, others[k]] - (rate[hurt, others[hurt]] - rate[hurt, others[hurt] - 1]).sum())

    gains = np.array([gain(k) for k in range(sites)])
    while True:
        gains[harvested] = 0
        k = int(gains.argmax())
        if gains[k] <= 1e-12:
            return float(rate[harvested, others[harvested]].sum())
        harvested[k] = True
        others[around[k]] -= 1
        again = {k, *around[k].tolist(), *(int(j) for i in around[k] for j in around[i])}
        for site in again:
            gains[site] = gain(site)
