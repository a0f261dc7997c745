"""Apples: harvest and random regrowth, on one world."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cprl.commons.chance import (
    BYTE_BITS,
    FIRST_STOCK,
    LOW_BYTE,
    REGROWTH_FIRST_BYTE,
    REGROWTH_REST,
    REST_BITS,
    SITES_PER_DRAW,
    WORD_SIZE,
    draw,
)
from cprl.commons.moves import cell_of, without_signal
from cprl.commons.quirks import keep_old_stock
from cprl.commons.river import pollute, slowed
from cprl.institutions.hooks import note_apple, note_bite, note_step, stops_bite
from cprl.values.arrays import Float32, Int64

if TYPE_CHECKING:
    from cprl.commons.tables import Tables
    from cprl.commons.world import Scratch, Worlds
    from cprl.institutions import Law

FROM_START, BEFORE_BITES, AFTER_BITES = range(3)
"""`Rules.growth`, in the order of its words."""


def fill(world: Worlds, tables: Tables) -> None:
    """Put an apple on every site, or under `first_stock_share` on a number of them drawn by chance."""
    sites = world.stock.shape[0]
    for k in range(sites):
        world.stock[k] = 1
        world.near[k] = tables.near_first[k + 1] - tables.near_first[k]
    world.stock_left[0] = sites
    if tables.first_stock < sites:
        draw_first_stock(world, tables)
    keep_old_stock(world, world.groups.quirks)


def draw_first_stock(world: Worlds, tables: Tables) -> None:
    """Leave apples on `first_stock` sites, all sets of that size equally likely: site by site, as many as
    are still wanted in so many sites (Knuth, The Art of Computer Programming, 3.4.2, algorithm S)."""
    wanted, sites = tables.first_stock, world.stock.shape[0]
    for k in range(sites):
        word = np.int64(draw(world, FIRST_STOCK | k)[0])
        is_kept = word * (sites - k) < wanted << WORD_SIZE
        world.stock[k] = is_kept
        wanted -= is_kept
    recount(world, tables)


def add_apple(world: Worlds, tables: Tables, law: Law | None, k: int) -> None:
    """Let an apple appear on site k, whatever brings it, and tell all that counts apples."""
    world.stock[k] = 1
    world.stock_left[0] += 1
    for n in range(tables.near_first[k], tables.near_first[k + 1]):
        world.near[tables.near_sites[n]] += 1
    if law is not None:
        note_apple(law, k, 1)


def remove_apple(world: Worlds, tables: Tables, law: Law | None, k: int) -> None:
    """Let the apple on site k vanish, whatever takes it, and tell all that counts apples."""
    world.stock[k] = 0
    world.stock_left[0] -= 1
    for n in range(tables.near_first[k], tables.near_first[k + 1]):
        world.near[tables.near_sites[n]] -= 1
    if law is not None:
        note_apple(law, k, -1)


def recount(world: Worlds, tables: Tables) -> None:
    """Recompute what follows from the stock: the apples left, and the apples near each site."""
    world.stock_left[0] = 0
    for k in range(world.stock.shape[0]):
        world.near[k] = 0
        world.stock_left[0] += world.stock[k]
        for n in range(tables.near_first[k], tables.near_first[k + 1]):
            world.near[k] += world.stock[tables.near_sites[n]]


def draw_first_bytes(world: Worlds, scratch: Scratch) -> None:
    """Draw the first byte of every site's random word into `scratch.words`, four sites per word."""
    sites = world.stock.shape[0]
    for number in range((sites + SITES_PER_DRAW - 1) // SITES_PER_DRAW):
        words = draw(world, REGROWTH_FIRST_BYTE + number)
        scratch.words[4 * number] = words[0]
        scratch.words[4 * number + 1] = words[1]
        scratch.words[4 * number + 2] = words[2]
        scratch.words[4 * number + 3] = words[3]


def find_sprouts(world: Worlds, tables: Tables, scratch: Scratch) -> int:
    """Find the sites that grow an apple in this turn, given the current stock; return their number.

    An empty site grows an apple if its random 32-bit word is below a threshold that depends on the number of
    apples near it. Sixteen sites share one draw for the first bytes of their words; the other three bytes are
    drawn only where the first byte does not decide. The first loop has no branch, because a processor cannot
    predict which sites are empty.
    """
    open_sites = 0
    draw_first_bytes(world, scratch)
    if tables.regrow_by_share:
        open_sites = find_open_by_share(world, tables, scratch)
    else:
        for k in range(world.stock.shape[0]):
            first_byte = (scratch.words[k >> 2] >> (8 * (k & 3))) & LOW_BYTE
            scratch.sprouts[open_sites] = k
            open_sites += (world.stock[k] == 0) & (first_byte <= tables.regrow_first_byte[world.near[k]])
    sprouts = 0
    for n in range(open_sites):
        k = scratch.sprouts[n]
        is_free = tables.regrow_under_agents or not is_stood_on(world, tables, k)
        if is_free and has_sprouted(world, tables, scratch, k):
            scratch.sprouts[sprouts] = k
            sprouts += 1
    return sprouts


def find_open_by_share(world: Worlds, tables: Tables, scratch: Scratch) -> int:
    """As the first loop of `find_sprouts`, where each site has its own row of thresholds."""
    open_sites = 0
    for k in range(world.stock.shape[0]):
        first_byte = (scratch.words[k >> 2] >> (8 * (k & 3))) & LOW_BYTE
        row = tables.regrow_row[k] + world.near[k]
        scratch.sprouts[open_sites] = k
        open_sites += (world.stock[k] == 0) & (first_byte <= tables.regrow_first_byte[row])
    return open_sites


def has_sprouted(world: Worlds, tables: Tables, scratch: Scratch, k: int) -> bool:
    """Return whether the whole random word of site k is below its threshold."""
    first_byte = (scratch.words[k >> 2] >> (8 * (k & 3))) & LOW_BYTE
    rest = np.int64(draw(world, REGROWTH_REST + k)[0]) >> BYTE_BITS
    row = tables.regrow_row[k] if tables.regrow_by_share else 0
    below = slowed(tables.regrow_below[row + world.near[k]], world.groups.river)
    return ((first_byte << REST_BITS) | rest) < below


def is_stood_on(world: Worlds, tables: Tables, k: int) -> bool:
    """Return whether an agent in play stands on site k."""
    for i in range(world.row.shape[0]):
        if world.in_play[i] and tables.site_at[cell_of(world.row[i], world.col[i], tables)] == k:
            return True
    return False


def grow(world: Worlds, tables: Tables, law: Law | None, scratch: Scratch, sprouts: int) -> None:
    """Add an apple on each site that `find_sprouts` found; `sprouts`: the number of these sites."""
    for s in range(sprouts):
        add_apple(world, tables, law, scratch.sprouts[s])


def bite_and_grow(
    world: Worlds, tables: Tables, law: Law | None, actions: Int64, scratch: Scratch, harvest: Float32
) -> int:
    """Let agents harvest and apples grow, in the order of `Rules.growth`; return the number of apples that
    grow."""
    if tables.growth == AFTER_BITES:
        bite(world, tables, law, actions, harvest)
    sprouts = find_sprouts(world, tables, scratch)
    pollute(world, world.groups.river)
    if tables.growth == BEFORE_BITES:
        grow(world, tables, law, scratch, sprouts)
    if tables.growth != AFTER_BITES:
        bite(world, tables, law, actions, harvest)
    if tables.growth != BEFORE_BITES:
        grow(world, tables, law, scratch, sprouts)
    return sprouts


def bite(world: Worlds, tables: Tables, law: Law | None, actions: Int64, harvest: Float32) -> None:
    """Let each agent in play that harvests (`harvest_action`) take the apple on its cell, unless an
    institution stops it, which notes what the agent breaks; `harvest`: float32 [N], 0 or 1.

    Two agents share a cell only where clashes are settled "pairwise": the lower index that may gets the
    apple.
    """
    for i in range(world.row.shape[0]):
        harvest[i] = 0.0
        if world.in_play[i]:
            cell = cell_of(world.row[i], world.col[i], tables)
            if law is not None:
                note_step(law, i, cell)
            k = tables.site_at[cell]
            if (
                k >= 0
                and world.stock[k] == 1
                and harvests(tables, actions[i])
                and may_bite(law, i, cell, k, world.step[0])
            ):
                remove_apple(world, tables, law, k)
                harvest[i] = 1.0
                world.harvested[i] += 1
                if law is not None:
                    note_bite(law, i, cell, k, world.step[0])


def harvests(tables: Tables, action: int) -> bool:
    """Return whether an agent that stands on an apple harvests it by its action."""
    return tables.harvest_number < 0 or tables.harvest_number == without_signal(tables, action)


def may_bite(law: Law | None, i: int, cell: int, k: int, step: int) -> bool:
    """Return whether no institution stops agent i from harvesting site k."""
    if law is None:
        return True
    return not stops_bite(law, i, cell, k, step)
