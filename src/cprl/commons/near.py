"""Which sites are near each other, for regrowth."""

from math import hypot
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cprl.commons.maps import Map
from cprl.commons.rules import Norm, Rules
from cprl.values.arrays import Bool, Float64, Int32, Int64, UInt32

_PAIRS_AT_ONCE: Final = 2**20
"""Pairs of a site and a cell or site around it that are compared at once."""


def distance(norm: Norm, rows: int, cols: int) -> float:
    """Return the distance between two cells, in cells, from their difference in rows and columns."""
    if norm == "euclidean":
        return hypot(rows, cols)
    if norm == "manhattan":
        return abs(rows) + abs(cols)
    return max(abs(rows), abs(cols))


def near_cells(rules: Rules, *, rows: int, cols: int) -> list[tuple[int, int]]:
    """Return the (rows, cols) from a cell to each other cell within `regrow_radius_cells`, so many rows and
    columns away at most."""
    reach = int(rules.regrow_radius_cells)
    return [
        (row, col)
        for row in range(-min(reach, rows), min(reach, rows) + 1)
        for col in range(-min(reach, cols), min(reach, cols) + 1)
        if (row, col) != (0, 0) and distance(rules.regrow_norm, row, col) <= rules.regrow_radius_cells
    ]


def neighbours(board: Map, rules: Rules) -> tuple[Int32, UInt32]:
    """Return the other sites within `regrow_radius_cells` of each site: `Tables.near_first`,
    `Tables.near_sites`."""
    sites, middle = np.array(board.sites), (board.height - 1, board.width - 1)
    offsets = np.array(near_cells(rules, rows=middle[0], cols=middle[1]), np.int64).reshape(-1, 2)
    on_cell = np.full((board.height, board.width), -1, np.int32)
    on_cell[tuple(sites.T)] = np.arange(len(sites))
    is_near = np.zeros((2 * board.height - 1, 2 * board.width - 1), np.bool_)
    is_near[tuple((offsets + middle).T)] = True
    counts, sites_near = [], []
    near: Bool
    others: NDArray[Any]
    at_once = max(1, _PAIRS_AT_ONCE // max(1, min(len(sites), len(offsets))))
    for first in range(0, len(sites), at_once):
        some = sites[first : first + at_once, None]
        if len(sites) <= len(offsets):
            near = is_near[tuple(np.moveaxis(sites - some + middle, -1, 0))]
            others = np.broadcast_to(np.arange(len(sites)), near.shape)
        else:
            cells = some + offsets
            inside = np.asarray(((cells >= 0) & (cells < on_cell.shape)).all(-1))
            others = on_cell[tuple(np.moveaxis(np.where(inside[..., None], cells, 0), -1, 0))]
            others = np.sort(np.where(inside, others, -1), 1)
            near = np.asarray(others >= 0)
        counts.append(near.sum(1))
        sites_near.append(others[near].astype(np.uint32))
    first_of = np.cumsum(np.concatenate([[0], *counts]), dtype=np.int32)
    return first_of, np.concatenate(sites_near)


def growth(rules: Rules, around: Int32) -> tuple[Int64, Float64]:
    """Return the probability that a site grows an apple, by the number of apples near it.

    Args:
        around: the number of sites near each site, [K].

    Returns:
        The row of each site, [K], and the rows, [rows, largest number of near sites + 1]. Entries of a row
        beyond the sites near are never used.
    """
    probs, most = np.array(rules.regrow_prob), int(around.max())
    if rules.regrow_by == "count":
        return np.zeros(1, np.int64), probs[np.minimum(np.arange(most + 1), len(probs) - 1)][None]
    sizes, of_site = np.unique(around + (rules.regrow_by == "share_with_own"), return_inverse=True)
    shares = np.arange(most + 1) / np.maximum(sizes, 1)[:, None]
    return of_site, np.interp(shares, np.linspace(0, 1, len(probs)), probs)


def bites_at_once(rules: Rules) -> bool:
    """Return whether an agent that stays on a site bites its apple in the turn in which it grows."""
    return rules.growth == "before_bites" and rules.regrow_under_agents


def kept_rates(rules: Rules, probs: Float64) -> Float64:
    """Return the apples a turn of a site that is bitten as soon as it holds one, [.., M], while at least m
    sites near it hold apples, from its probabilities of growth by their number m, [.., M].

    With p the lowest of these from m on, it bears p, or p / (1 + p) where it stands full for the turn in
    which it is bitten.
    """
    lowest = np.minimum.accumulate(probs[..., ::-1], -1)[..., ::-1]
    return lowest if bites_at_once(rules) else lowest / (1 + lowest)


def sites_around(board: Map, rules: Rules) -> list[Int64]:
    """Return the sites near each site, int64 [..] each."""
    first, near = neighbours(board, rules)
    return np.split(near.astype(np.int64), first[1:-1])


def patches(around: list[Int64]) -> Int32:
    """Return the patch of each site, int32 [K]: sites that are connected by being near each other."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    ends = np.concatenate(around), np.repeat(np.arange(len(around)), list(map(len, around)))
    links = csr_array((np.ones(len(ends[0])), ends), shape=(len(around), len(around)))
    patch: Int32 = connected_components(links, directed=False)[1].astype(np.int32)
    return patch
