"""Apples: where they grow by chance, and who bites them. All on ONE world."""

import numpy as np
from numpy.typing import NDArray

from cprl.commons.chance import (
    BYTE_BITS,
    LOW_BYTE,
    LOW_WORD,
    REGROWTH_FIRST_BYTE,
    REGROWTH_REST,
    REST_BITS,
    SITES_PER_DRAW,
    WORD_BITS,
    philox4x32,
)
from cprl.commons.moves import cell_of
from cprl.commons.tables import Tables
from cprl.commons.world import Scratch, Worlds


def fill(world: Worlds, tables: Tables) -> None:
    """An apple on every site."""
    sites = world.stock.shape[0]
    for k in range(sites):
        world.stock[k] = 1
        world.stock_before[k] = 1
        world.near[k] = tables.near_first[k + 1] - tables.near_first[k]
    world.stock_left[0] = sites


def hang(world: Worlds, tables: Tables, k: int) -> None:
    """An apple appears on site k."""
    world.stock[k] = 1
    world.stock_left[0] += 1
    for n in range(tables.near_first[k], tables.near_first[k + 1]):
        world.near[tables.near_sites[n]] += 1


def pick(world: Worlds, tables: Tables, k: int) -> None:
    """The apple on site k is gone."""
    world.stock[k] = 0
    world.stock_left[0] -= 1
    for n in range(tables.near_first[k], tables.near_first[k + 1]):
        world.near[tables.near_sites[n]] -= 1


def recount(world: Worlds, tables: Tables) -> None:
    """What follows from the stock: how many apples are left, and how many near each site."""
    world.stock_left[0] = 0
    for k in range(world.stock.shape[0]):
        world.near[k] = 0
        world.stock_left[0] += world.stock[k]
        for n in range(tables.near_first[k], tables.near_first[k + 1]):
            world.near[k] += world.stock[tables.near_sites[n]]


def draw(world: Worlds, number: int) -> tuple[np.uint64, np.uint64, np.uint64, np.uint64]:
    """Four random words for this world, episode and step."""
    return philox4x32(
        np.uint64(number),
        np.uint64(world.step[0]),
        np.uint64(world.episode[0]),
        world.number[0],
        world.seed[0] & LOW_WORD,
        world.seed[0] >> WORD_BITS,
    )


def draw_first_bytes(world: Worlds, scratch: Scratch) -> None:
    """The first byte of every site's random word into `scratch.words`, four sites a word."""
    sites = world.stock.shape[0]
    for number in range((sites + SITES_PER_DRAW - 1) // SITES_PER_DRAW):
        words = draw(world, REGROWTH_FIRST_BYTE + number)
        scratch.words[4 * number] = words[0]
        scratch.words[4 * number + 1] = words[1]
        scratch.words[4 * number + 2] = words[2]
        scratch.words[4 * number + 3] = words[3]


def find_sprouts(world: Worlds, tables: Tables, scratch: Scratch) -> int:
    """The sites that grow an apple this turn, by the stock as it stands; returns how many.

    An empty site grows an apple if its random 32-bit word falls below what its neighbours allow. Sixteen
    sites draw their first bytes together; only where that leaves it open are the other three drawn. The
    first loop has no branch, since which sites are empty is nothing that a processor could guess.
    """
    open_sites = 0
    draw_first_bytes(world, scratch)
    for k in range(world.stock.shape[0]):
        first_byte = (scratch.words[k >> 2] >> (8 * (k & 3))) & LOW_BYTE
        scratch.sprouts[open_sites] = k
        open_sites += (world.stock[k] == 0) & (first_byte <= tables.regrow_first_byte[world.near[k]])
    sprouts = 0
    for n in range(open_sites):
        k = scratch.sprouts[n]
        if has_sprouted(world, tables, scratch, k):
            scratch.sprouts[sprouts] = k
            sprouts += 1
    return sprouts


def has_sprouted(world: Worlds, tables: Tables, scratch: Scratch, k: int) -> bool:
    """Whether the whole random word of site k falls below what its neighbours allow."""
    first_byte = (scratch.words[k >> 2] >> (8 * (k & 3))) & LOW_BYTE
    rest = np.int64(draw(world, REGROWTH_REST + k)[0]) >> BYTE_BITS
    return ((first_byte << REST_BITS) | rest) < tables.regrow_below[world.near[k]]


def grow(world: Worlds, tables: Tables, scratch: Scratch, sprouts: int) -> None:
    """The apples found by `find_sprouts` appear."""
    for s in range(sprouts):
        hang(world, tables, scratch.sprouts[s])


def bite(world: Worlds, tables: Tables, harvest: NDArray[np.float32]) -> None:
    """Everyone in play bites the apple on its cell, if it may; `harvest`: float32 [N], apples bitten.

    Two on one cell are met only under `pairwise_clashes`: the lower number gets the apple.
    """
    for i in range(world.row.shape[0]):
        harvest[i] = 0.0
        if world.in_play[i]:
            k = tables.site_at[cell_of(world.row[i], world.col[i], tables)]
            if k >= 0 and world.stock[k] == 1 and tables.may_bite[i, k]:
                pick(world, tables, k)
                harvest[i] = 1.0
                world.harvested[i] += 1


FUNCTIONS = (fill, hang, pick, recount, draw, draw_first_bytes, has_sprouted, find_sprouts, grow, bite)
"""In the order in which they call each other, as `compiled.py` compiles them."""
