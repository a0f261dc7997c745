"""Find the sites that are near each other, on which regrowth depends, and how fast apples grow there."""

from math import hypot

import numpy as np

from cprl.commons.maps import Map
from cprl.commons.rules import Norm, Rules
from cprl.values.array_types import Float64, Int32, Int64, UInt32


def distance(norm: Norm, rows: int, cols: int) -> float:
    """Return the distance in cells between two cells that are `rows` and `cols` apart."""
    if norm == "euclidean":
        return hypot(rows, cols)
    if norm == "manhattan":
        return abs(rows) + abs(cols)
    return max(abs(rows), abs(cols))


def near_cells(rules: Rules, *, rows: int, cols: int) -> list[tuple[int, int]]:
    """Return the steps (row, col) from a cell to each other cell within `regrow_radius_cells`.

    Steps go at most `rows` up or down and `cols` left or right, e.g. the size of the board.
    """
    reach = int(rules.regrow_radius_cells)
    most_rows = min(reach, rows)
    most_cols = min(reach, cols)
    return [
        (row, col)
        for row in range(-most_rows, most_rows + 1)
        for col in range(-most_cols, most_cols + 1)
        if (row, col) != (0, 0) and distance(rules.regrow_norm, row, col) <= rules.regrow_radius_cells
    ]


def neighbours(board: Map, rules: Rules) -> tuple[Int32, UInt32]:
    """Find the other sites within `regrow_radius_cells` of each site.

    In reading order, the near sites of a site follow one another within each row of the board. So for each
    site and row a range of sites is found by bisection.

    Returns:
        `Tables.near_first`, [K + 1], and `Tables.near_sites`, which holds the near sites of site 0, of site
        1, and so on.
    """
    last_columns = dict(near_cells(rules, rows=board.height - 1, cols=board.width - 1))
    # From each row to the last column of the near cells in it; they lie symmetrically around the site.
    row_steps = np.array([*last_columns], np.int64)
    half_widths = np.array([*last_columns.values()], np.int64)
    stride = 2 * board.width  # so wide that no row of near cells reaches into the next one
    cells = np.array(board.sites) @ (stride, 1)
    order = np.argsort(cells).astype(np.int32)
    middles = cells[:, None] + stride * row_steps
    range_starts = np.searchsorted(cells[order], middles - half_widths)
    range_lengths = np.searchsorted(cells[order], middles + half_widths, side="right") - range_starts
    counts = range_lengths.sum(1)
    sites = np.repeat(np.arange(len(cells), dtype=np.int32), counts)
    near = order[_concatenated_ranges(range_starts.reshape(-1), range_lengths.reshape(-1))]
    if (np.diff(order) < 0).any():  # sites that are not in reading order
        near = near[np.lexsort((near, sites))]
    near_sites = near[near != sites].astype(np.uint32)
    counts_without_itself = counts - (0 in last_columns)
    near_first = np.concatenate([[0], np.cumsum(counts_without_itself)])
    return near_first.astype(np.int32), near_sites


def _concatenated_ranges(starts: Int64, lengths: Int64) -> Int32:
    """Return the numbers of ranges, one after another: starts 3, 7 and lengths 2, 3 give 3, 4, 7, 8, 9."""
    positions = np.cumsum(lengths) - lengths
    numbers: Int32 = np.arange(lengths.sum(), dtype=np.int32)
    return numbers + np.repeat((starts - positions).astype(np.int32), lengths)


def growth_probs(rules: Rules, near_counts: Int32) -> tuple[Int64, Float64]:
    """Return the probabilities per turn that sites grow an apple, by the number of apples near them.

    Args:
        rules: the rules of the game.
        near_counts: the number of sites near each site, [K].

    Returns:
        The row of each site in the table, [K] (or [1], with the row of all sites), and the table of
        probabilities, [rows, largest number of near sites + 1]. A site never uses the entries of its row
        beyond the number of sites near it.
    """
    probs = np.array(rules.regrow_prob)
    most_near = int(near_counts.max())
    if rules.regrow_by == "count":
        return np.zeros(1, np.int64), probs[np.minimum(np.arange(most_near + 1), len(probs) - 1)][None]
    sizes, row_of_site = np.unique(near_counts + (rules.regrow_by == "share_with_own"), return_inverse=True)
    shares = np.arange(most_near + 1) / np.maximum(sizes, 1)[:, None]
    return row_of_site, np.interp(shares, np.linspace(0, 1, len(probs)), probs)


def harvests_at_once(rules: Rules) -> bool:
    """Return whether an agent that stays on a site harvests an apple in the turn in which it grows."""
    return rules.growth == "before_bites" and rules.regrow_under_agents


def harvest_rates(rules: Rules, probs: Float64) -> Float64:
    """Return the apples per turn that a site yields if it is harvested whenever it holds one, [.., M].

    Entry m is the yield while at least m sites near it hold apples. With p the lowest probability of growth
    from m on, the site yields p, or p / (1 + p) if it stands full for the turn in which it is harvested.

    Args:
        rules: the rules of the game.
        probs: [.., M], the probability of growth by the number m of near sites that hold apples.
    """
    lowest = np.minimum.accumulate(probs[..., ::-1], -1)[..., ::-1]
    return lowest if harvests_at_once(rules) else lowest / (1 + lowest)


def sites_around(board: Map, rules: Rules) -> list[Int64]:
    """Return for each site the indices of the sites near it, int64 with one axis."""
    first, near = neighbours(board, rules)
    return np.split(near.astype(np.int64), first[1:-1])


def patches(around: list[Int64]) -> Int32:
    """Return the index of each site's patch, int32 [K].

    Sites belong to one patch if they are near each other, directly or through other sites. `around`: a result
    of `sites_around`.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    site_count = len(around)
    near_sites = np.concatenate(around)
    sites = np.repeat(np.arange(site_count), list(map(len, around)))
    links = csr_array((np.ones(len(sites)), (near_sites, sites)), shape=(site_count, site_count))
    patch_of_site: Int32 = connected_components(links, directed=False)[1].astype(np.int32)
    return patch_of_site
