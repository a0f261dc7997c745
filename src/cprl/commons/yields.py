"""The sustainable yield of a map: a lower bound on the harvest that lasts for ever, where it is proven."""

from typing import Final

import numpy as np

from cprl.commons.maps import Map
from cprl.commons.near import growth_probs, harvest_rates, sites_around
from cprl.commons.rules import Rules
from cprl.values.array_types import Float64, Int64

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
"""The fields of `Rules` that may have any value in the proof of the bound, except for the case in `unproven`,
and on boards with a river only while that is clean. Add a new rule about how apples come or go only once its
bound is proven."""


def unproven(rules: Rules) -> list[str]:
    """Return the names of the rules of a game under which its yield is not proven, in alphabetical order.

    `first_stock_share` is one of them where nothing grows without apples near: there a site that begins
    without apples near it may stay empty.
    """
    names = {*rules.changed} - PROVEN
    if rules.first_stock_share < 1 and rules.regrow_prob[0] == 0:
        names.add("first_stock_share")
    return sorted(names)


def check_proven(rules: Rules) -> None:
    """Raise a ValueError for rules under which no yield is proven."""
    names = unproven(rules)
    if names:
        raise ValueError(
            f"Rules.{names[0]} is {rules.changed[names[0]]!r}, with which no yield of a board is proven; "
            "allowed: its default where a yield is asked for, e.g. by a Quota"
        )


def sustainable_yield(board: Map, rules: Rules) -> float:
    """Return a number of apples per turn that can be harvested for ever; more may be possible.

    The bound is proven by a way to reach it: agents harvest some sites as soon as they hold an apple, and the
    others never. A greedy search chooses the harvested sites. A harvested site with m unharvested sites near
    it grows an apple in every turn in which it is empty, with a probability of at least
    p = min(`regrow_prob`[m:]). It stands full for the turn in which it is harvested, so it yields p / (1 + p)
    apples per turn. Where apples grow before harvests, also under agents, it yields p. For example, an
    isolated cross under the published probabilities has two harvested sites with three apples near each, and
    yields 0.1 apples per turn in the variant "as_run".

    On a map with a river this is the yield while the river is clean, and no bound otherwise.

    Raises:
        ValueError: for rules outside `PROVEN`.
    """
    check_proven(rules)
    around = sites_around(board, rules)
    row_of_site, probs = growth_probs(rules, np.array([len(sites) for sites in around], np.int32))
    rates = harvest_rates(rules, probs)
    return _greedy_yield(np.broadcast_to(rates[row_of_site], (len(around), rates.shape[1])), around)


_SMALLEST_GAIN: Final = 1e-12
"""Apples per turn; the greedy search stops at smaller gains, which may be rounding errors."""


def _greedy_yield(rate: Float64, around: list[Int64]) -> float:
    """Return the yield of the harvested sites that a greedy search finds.

    The search adds the site that raises the yield most, until no site raises it.

    Args:
        rate: [K, counts], the yield of each site by the number of unharvested sites near it.
        around: the sites near each site.
    """
    site_count = len(around)
    unharvested_near = np.array([len(near_sites) for near_sites in around])
    harvested = np.zeros(site_count, np.bool_)

    def gain(site: int) -> float:
        """Return the yield of a site, less the loss of the harvested sites near it, if it is added."""
        losers = around[site][harvested[around[site]]]
        counts = unharvested_near[losers]
        losses = rate[losers, counts] - rate[losers, counts - 1]
        return float(rate[site, unharvested_near[site]] - losses.sum())

    gains = np.array([gain(site) for site in range(site_count)])
    while True:
        gains[harvested] = 0
        best = int(gains.argmax())
        if gains[best] <= _SMALLEST_GAIN:
            return float(rate[harvested, unharvested_near[harvested]].sum())
        harvested[best] = True
        near = around[best].tolist()
        unharvested_near[near] -= 1
        for site in {best, *near, *(int(second) for first in near for second in around[first])}:
            gains[site] = gain(site)
