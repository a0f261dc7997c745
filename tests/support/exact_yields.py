"""exact_yield: what apples can bear on a board of a few sites, exactly, as a check of `yield_bounds`."""

from dataclasses import dataclass
from itertools import product

import numpy as np

from cprl.commons.near import sites_around

MOST_SITES = 7
TOLERANCE = 1e-9
"""Apples per turn by which the best policy may be better than the one that is found."""
SHARE = 0.9
"""The share of turns in which time passes: in the others all stays as it is, so that no policy goes round in
circles, which changes neither the best policy nor its yield per turn (Schweitzer 1971)."""


@dataclass(frozen=True)
class ExactYield:
    """What a board bears for ever, harvested as well as can be, from a full stock on."""

    per_step: float
    """Apples per turn."""
    kept: float
    """Apples that are left after the bites of a turn."""


def exact_yield(board, rules, *, bites_per_step=None, sees_growth=False):
    """Return the largest long-run harvest of up to 7 sites, by value iteration over all their stocks.

    Before each turn a set of sites is chosen by the stock, and every apple there is bitten, also one that
    grows in this turn where the rules let it be (growth "before_bites"). Ways, clashes and beams are left
    out: the harvester is where it wants to be. The policy found is evaluated exactly, and proven to be within
    `TOLERANCE` of the best by the largest gain of a round (Odoni 1969, for value iteration).

    Args:
        bites_per_step: sites that can be visited in a turn; by default all.
        sees_growth: whether the sites are chosen after the turn's growth, where that is before the bites.
    """
    sites = len(board.sites)
    if sites > MOST_SITES:
        raise ValueError(f"the board has {sites} sites; allowed: up to {MOST_SITES}")
    chances, bitten, left = _moves(
        board, rules, sites if bites_per_step is None else bites_per_step, sees_growth
    )
    values = np.zeros(2**sites)
    for _ in range(100):
        for _ in range(500):
            worth = SHARE * (bitten + chances @ values) + (1 - SHARE) * values
            gains = (worth.max(0) - values) / SHARE
            values = worth.max(0)
        policy = worth.argmax(0), np.arange(len(values))
        moves = SHARE * chances[policy] + (1 - SHARE) * np.eye(len(values))
        for _ in range(40):  # 2**40 turns, after which a policy is in its long run
            moves = moves @ moves
            moves /= moves.sum(1, keepdims=True)
        per_step = moves[-1] @ bitten[policy]
        if gains.max() - per_step < TOLERANCE:
            return ExactYield(per_step, moves[-1] @ left[policy])
    raise RuntimeError("no policy was proven best, since apples hardly ever grow")


def _moves(board, rules, most, sees_growth):
    """Return what follows on visiting each set of sites, [A], chosen at each stock, [2**K]: the
    probability of each next stock, the mean apples bitten, and the mean apples left."""
    sites = len(board.sites)
    is_full = np.array(list(product((False, True), repeat=sites)))[:, ::-1]  # of each stock, [2**K, K]
    counts = np.stack([is_full[:, near].sum(1) for near in sites_around(board, rules)], 1)
    probs = np.array(rules.regrow_prob)
    prob = np.where(is_full, 0.0, probs[np.minimum(counts, len(probs) - 1)])
    growth = np.where(is_full[None], prob[:, None], 1 - prob[:, None]).prod(-1)  # by stock, that these grow
    apples = is_full.sum(1)
    stocks, grown = np.broadcast_arrays(np.arange(2**sites)[:, None], np.arange(2**sites))
    is_before = rules.growth == "before_bites"
    moves = []
    for visited in (chosen for chosen in range(2**sites) if chosen.bit_count() <= most):
        there = stocks | grown if is_before and not sees_growth else stocks
        left = there & ~visited
        sets = growth[left[:, 0]] if is_before and sees_growth else growth
        chances = np.zeros(growth.shape)
        np.add.at(chances, (stocks, left if there is not stocks else left | grown), sets)
        moves.append((chances, (sets * apples[there & visited]).sum(1), (sets * apples[left]).sum(1)))
    return map(np.stack, zip(*moves, strict=True))
