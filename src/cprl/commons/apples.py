"""Apples: how they are harvested and grow back by chance. The rules work on one world."""

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
from cprl.commons.moves import cell_of
from cprl.commons.quirks import keep_old_stock
from cprl.commons.river import pollute, reduced_threshold
from cprl.commons.signals import SignalArrays, without_signal
from cprl.institutions.hooks import note_apple, note_harvest, note_step, stops_harvest
from cprl.values.array_types import Float32, Int64

if TYPE_CHECKING:
    from cprl.commons.tables import Tables
    from cprl.commons.world import Scratch, Worlds
    from cprl.institutions import Law

FROM_START, BEFORE_BITES, AFTER_BITES = range(3)
"""The values of `Tables.growth`, in the order of the words that `Rules.growth` allows."""


def fill(world: Worlds, tables: Tables) -> None:
    """Begin an episode with an apple on every site, or on `first_stock` sites drawn by chance."""
    sites = world.stock.shape[0]
    for site in range(sites):
        world.stock[site] = 1
        world.near[site] = tables.near_first[site + 1] - tables.near_first[site]
    world.stock_left[0] = sites
    if tables.first_stock < sites:
        draw_first_stock(world, tables)
    keep_old_stock(world, world.groups.quirks)


def draw_first_stock(world: Worlds, tables: Tables) -> None:
    """Put apples on `first_stock` sites, where every set of that size is equally likely.

    The sites are visited in order. Each gets an apple with the probability m / s, where m apples are still
    missing and s sites are left to visit (Knuth, The Art of Computer Programming, 3.4.2, algorithm S).
    """
    missing = tables.first_stock
    sites = world.stock.shape[0]
    for site in range(sites):
        word = np.int64(draw(world, FIRST_STOCK | site)[0])
        has_apple = word * (sites - site) < missing << WORD_SIZE
        world.stock[site] = has_apple
        missing -= has_apple
    recount(world, tables)


def add_apple(world: Worlds, tables: Tables, law: Law | None, site: int) -> None:
    """Put an apple on a site, and update every count of apples."""
    world.stock[site] = 1
    world.stock_left[0] += 1
    for pair in range(tables.near_first[site], tables.near_first[site + 1]):
        world.near[tables.near_sites[pair]] += 1
    if law is not None:
        note_apple(law, site, 1)


def remove_apple(world: Worlds, tables: Tables, law: Law | None, site: int) -> None:
    """Take the apple from a site, and update every count of apples."""
    world.stock[site] = 0
    world.stock_left[0] -= 1
    for pair in range(tables.near_first[site], tables.near_first[site + 1]):
        world.near[tables.near_sites[pair]] -= 1
    if law is not None:
        note_apple(law, site, -1)


def recount(world: Worlds, tables: Tables) -> None:
    """Count the apples on the board, and the apples near each site, from the stock alone."""
    world.stock_left[0] = 0
    for site in range(world.stock.shape[0]):
        world.near[site] = 0
        world.stock_left[0] += world.stock[site]
        for pair in range(tables.near_first[site], tables.near_first[site + 1]):
            world.near[site] += world.stock[tables.near_sites[pair]]


def draw_first_bytes(world: Worlds, scratch: Scratch) -> None:
    """Draw the first byte of every site's random word into `scratch.words`, four sites per word."""
    sites = world.stock.shape[0]
    for draw_index in range((sites + SITES_PER_DRAW - 1) // SITES_PER_DRAW):
        words = draw(world, REGROWTH_FIRST_BYTE + draw_index)
        scratch.words[4 * draw_index] = words[0]
        scratch.words[4 * draw_index + 1] = words[1]
        scratch.words[4 * draw_index + 2] = words[2]
        scratch.words[4 * draw_index + 3] = words[3]


def find_sprouts(world: Worlds, tables: Tables, scratch: Scratch) -> int:
    """Write the sites that grow an apple in this turn into `scratch.sprouts`, and return their number.

    An empty site grows an apple if its random 32-bit word is below a threshold, which depends on the number
    of apples near it. Sixteen sites share one draw for the first bytes of their words. The first loop keeps
    the sites that may grow an apple by their first byte; only for these the other three bytes are drawn. It
    has no branch, because a processor cannot predict which sites are empty.
    """
    open_sites = 0
    draw_first_bytes(world, scratch)
    if tables.regrow_by_share:
        open_sites = find_open_by_share(world, tables, scratch)
    else:
        for site in range(world.stock.shape[0]):
            first_byte = (scratch.words[site >> 2] >> (8 * (site & 3))) & LOW_BYTE
            scratch.sprouts[open_sites] = site
            open_sites += (world.stock[site] == 0) & (
                first_byte <= tables.regrow_first_byte[world.near[site]]
            )
    sprouts = 0
    for candidate in range(open_sites):
        site = scratch.sprouts[candidate]
        is_free = tables.regrow_under_agents or not is_stood_on(world, tables, site)
        if is_free and has_sprouted(world, tables, scratch, site):
            scratch.sprouts[sprouts] = site
            sprouts += 1
    return sprouts


def find_open_by_share(world: Worlds, tables: Tables, scratch: Scratch) -> int:
    """Find the sites that may grow an apple by their first byte, where each site has its own thresholds."""
    open_sites = 0
    for site in range(world.stock.shape[0]):
        first_byte = (scratch.words[site >> 2] >> (8 * (site & 3))) & LOW_BYTE
        row = tables.regrow_row[site] + world.near[site]
        scratch.sprouts[open_sites] = site
        open_sites += (world.stock[site] == 0) & (first_byte <= tables.regrow_first_byte[row])
    return open_sites


def has_sprouted(world: Worlds, tables: Tables, scratch: Scratch, site: int) -> bool:
    """Return whether a site grows an apple: its whole random word is below its threshold."""
    first_byte = (scratch.words[site >> 2] >> (8 * (site & 3))) & LOW_BYTE
    rest = np.int64(draw(world, REGROWTH_REST + site)[0]) >> BYTE_BITS
    row = tables.regrow_row[site] if tables.regrow_by_share else 0
    threshold = reduced_threshold(tables.regrow_below[row + world.near[site]], world.groups.river)
    return ((first_byte << REST_BITS) | rest) < threshold


def is_stood_on(world: Worlds, tables: Tables, site: int) -> bool:
    """Return whether an agent in play stands on a site."""
    for agent in range(world.row.shape[0]):
        if (
            world.in_play[agent]
            and tables.site_at[cell_of(world.row[agent], world.col[agent], tables)] == site
        ):
            return True
    return False


def grow(world: Worlds, tables: Tables, law: Law | None, scratch: Scratch, sprouts: int) -> None:
    """Put an apple on each site that `find_sprouts` found; `sprouts`: the number of these sites."""
    for sprout in range(sprouts):
        add_apple(world, tables, law, scratch.sprouts[sprout])


def harvest_and_grow(
    world: Worlds, tables: Tables, law: Law | None, actions: Int64, scratch: Scratch, harvest: Float32
) -> int:
    """Let agents harvest and apples grow, in the order that `Rules.growth` says.

    `actions`: int64 [N]; `harvest`: float32 [N], written. Return the number of apples that grew.
    """
    if tables.growth == AFTER_BITES:
        harvest_apples(world, tables, law, actions, harvest)
    sprouts = find_sprouts(world, tables, scratch)
    pollute(world, world.groups.river)
    if tables.growth == BEFORE_BITES:
        grow(world, tables, law, scratch, sprouts)
    if tables.growth != AFTER_BITES:
        harvest_apples(world, tables, law, actions, harvest)
    if tables.growth != BEFORE_BITES:
        grow(world, tables, law, scratch, sprouts)
    return sprouts


def harvest_apples(world: Worlds, tables: Tables, law: Law | None, actions: Int64, harvest: Float32) -> None:
    """Let each agent in play take the apple on its cell; write 1 or 0 to `harvest`, float32 [N].

    With `Rules.harvest_action` an agent must have chosen the action "harvest". Institutions may stop a
    harvest, or note the rule that it breaks. Two agents share a cell only where clashes are settled
    "pairwise": then the agent with the lower index comes first.
    """
    for agent in range(world.row.shape[0]):
        harvest[agent] = 0.0
        if world.in_play[agent]:
            cell = cell_of(world.row[agent], world.col[agent], tables)
            if law is not None:
                note_step(law, agent, cell)
            site = tables.site_at[cell]
            if (
                site >= 0
                and world.stock[site] == 1
                and harvests(tables, world.groups.signals, actions[agent])
                and may_be_harvested(law, agent, cell, site, world.step[0])
            ):
                remove_apple(world, tables, law, site)
                harvest[agent] = 1.0
                world.harvested[agent] += 1
                if law is not None:
                    note_harvest(law, agent, cell, site, world.step[0])


def harvests(tables: Tables, signals: SignalArrays | None, action: int) -> bool:
    """Return whether an action harvests the apple on which the agent stands."""
    return tables.harvest_number < 0 or tables.harvest_number == without_signal(action, signals)


def may_be_harvested(law: Law | None, agent: int, cell: int, site: int, step: int) -> bool:
    """Return whether institutions let an agent harvest a site, which lies on a cell."""
    if law is None:
        return True
    return not stops_harvest(law, agent, cell, site, step)
