"""The river: waste that keeps apples from growing, and beams that clean it, on one world."""

import numpy as np

from cprl.commons.beam import beam_begin, beam_cell, beam_end
from cprl.commons.chance import POLLUTION, draw
from cprl.commons.colours import WALL
from cprl.commons.moves import cell_of, draw_order
from cprl.commons.tables import Tables
from cprl.commons.world import Floats, Scratch, Worlds


def begin_river(world: Worlds, tables: Tables) -> None:
    """Puts waste on the cells that have some when an episode begins."""
    for r in range(world.waste.shape[0]):
        world.waste[r] = tables.first_waste[r]
    count_waste(world)


def count_waste(world: Worlds) -> None:
    """Recomputes the number of cells with waste."""
    world.waste_left[0] = 0
    for r in range(world.waste.shape[0]):
        world.waste_left[0] += world.waste[r]


def clean(world: Worlds, tables: Tables, scratch: Scratch, cleaned: Floats) -> None:
    """Agents that clean do so one after another, in an order drawn by chance; `cleaned`: float32 [N],
    cells cleaned."""
    draw_order(world, scratch)
    for n in range(world.row.shape[0]):
        i = scratch.order[n]
        cleaned[i] = 0.0
        if world.cleans[i]:
            for side in range(-tables.beam_half_width, tables.beam_half_width + 1):
                cleaned[i] += clean_column(world, tables, i, side)


def clean_column(world: Worlds, tables: Tables, i: int, side: int) -> int:
    """Cleans the first cell with waste in a column of agent i's beam, which ends there, at a wall or at an
    agent; returns the cells cleaned."""
    for ahead in range(beam_begin(tables, side), beam_end(world, tables, i, side) + 1):
        cell = beam_cell(world, tables, i, ahead, side)
        if tables.background[cell] == tables.paints[WALL]:
            return 0
        r = tables.river_at[cell]
        if r >= 0 and world.waste[r] == 1:
            world.waste[r] = 0
            world.waste_left[0] -= 1
            return 1
        for j in range(world.row.shape[0]):
            if world.in_play[j] and cell_of(world.row[j], world.col[j], tables) == cell:
                return 0
    return 0


def growth_share(world: Worlds, tables: Tables) -> float:
    """What is left of the growth of apples at this share of waste, 0..1."""
    share = world.waste_left[0] / max(1, world.waste.shape[0])
    if share >= tables.pollution_limit:
        return 0.0
    return min(1.0, (tables.pollution_limit - share) / (tables.pollution_limit - tables.pollution_free))


def pollute(world: Worlds, tables: Tables) -> None:
    """Puts waste on a clean cell of the river, or on none; all clean cells are equally likely."""
    cells = world.waste.shape[0]
    left = cells - world.waste_left[0]
    words = draw(world, POLLUTION)
    if growth_share(world, tables) == 0.0 or np.int64(words[0]) >= tables.pollute_below[left]:
        return
    place = np.int64(words[1] % np.uint64(left))
    for r in range(cells):
        if world.waste[r] == 0:
            if place == 0:
                world.waste[r] = 1
                world.waste_left[0] += 1
            place -= 1
