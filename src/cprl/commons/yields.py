"""What a map can bear: a proven lower bound of its sustainable yield, and for which rules it is proven."""

from typing import Final

import numpy as np

from cprl.commons.maps import Map
from cprl.commons.near import growth, kept_rates, sites_around
from cprl.commons.rules import Rules
from cprl.values.arrays import Float64, Int64

PROVEN: Final = frozenset(
    (
        *("regrow_prob", "regrow_radius_cells", "regrow_norm", "regrow_by", "regrow_under_agents", "growth"),
        *("first_stock_share", "harvest_action", "beam_length_cells", "beam_width_cells", "hits_to_tag"),
        *("freeze_steps", "beam_tapers", "beam_from_beside", "beam_stops_at_agents", "cooldown_steps"),
        *("may_fire", "signals", "window_rows", "window_rows_behind", "window_columns", "episode_steps"),
        *("random_end", "plays_on_when_empty", "shuffle_starts", "random_headings", "respawn_at_spawns"),
        *("clashes", "river", "quirks"),
    )
)
"""The fields of `Rules` for which the bound is proven, but for what `unproven` says, of a river while that is
clean. A rule
that lets apples come or go in another way is not among them until somebody has proven it."""


def unproven(rules: Rules) -> list[str]:
    """Return the names of the rules of a game for which no yield is proven.

    Where nothing grows without apples near, sites that begin without them may stay empty.
    """
    may_stay_empty = rules.first_stock_share < 1 and rules.regrow_prob[0] == 0
    return sorted({*rules.changed} - PROVEN | ({"first_stock_share"} if may_stay_empty else set()))


def check_proven(rules: Rules) -> None:
    """Refuse rules for which no yield is proven."""
    names = unproven(rules)
    if names:
        raise ValueError(
            f"Rules.{names[0]} is {rules.changed[names[0]]!r}, with which no yield of a board is proven; "
            "allowed: its default where a yield is asked for, e.g. by a Quota"
        )


def sustainable_yield(board: Map, rules: Rules) -> float:
    """Return the apples per turn that can be harvested for ever: a lower bound, proven by a way to reach it.

    Some sites are harvested as soon as they hold an apple, the others never. A harvested site with m
    unharvested sites near it then grows an apple in every turn in which it is empty with at least the
    probability p = min(`regrow_prob`[m:]). So it bears p / (1 + p) apples a turn: it stands full for the turn
    in which it is bitten, except where apples grow before bites, also under agents, where it bears p.
    Which sites are harvested is found by a greedy search, so more may be possible. An isolated cross under
    the published probabilities has two harvested sites with three apples near each: 0.1 apples a turn as run.

    On a map with a river it is the yield of a clean river, and no bound otherwise.

    Raises:
        ValueError: for rules that are not `PROVEN`.
    """
    check_proven(rules)
    around = sites_around(board, rules)
    of_site, probs = growth(rules, np.array([len(some) for some in around], np.int32))
    rates = kept_rates(rules, probs)
    return _best(np.broadcast_to(rates[of_site], (len(around), rates.shape[1])), around)


def _best(rate: Float64, around: list[Int64]) -> float:
    """Return the yield of the harvested sites that a greedy search finds: each added while the sum grows.

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
