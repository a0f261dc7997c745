"""The picture of the board, and the observations that agents have of it. The rules work on one world.

The picture holds a paint for each cell, which is a colour together with a class. It follows from the state of
the world alone, so it can be drawn again at any time. A window is the part of the picture that an agent
observes.

An observation has further planes after the channels of cells. The planes "scoreboard" and "stock_gauge" are
described in `Observation`. The plane "forbidden" is 255 on the cells where a harvest would break a rule about
places. The planes "institutions" hold the values of `cprl.institutions.hooks.shown_value`, scaled to 0..255:
with S entries, cell n of these planes, counted row by row, shows entry n modulo S. So a single entry fills a
plane evenly, as is usual for numbers that convolutions read beside a board.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cprl.commons.beam import beam_begin, beam_cell, beam_reach
from cprl.commons.cells import (
    APPLE,
    BEAM,
    CLEANING,
    FIRST_AGENT,
    GROUND,
    MARK,
    OTHER,
    SELF,
    WALL,
    WASTE,
    WATER,
)
from cprl.commons.headings import COL_STEP, ROW_STEP
from cprl.commons.moves import cell_of
from cprl.commons.quirks import mark_ahead, paints_over, self_stays, shows_apple
from cprl.commons.river import is_cleaning
from cprl.institutions.hooks import is_seen_as_forbidden, shown_value
from cprl.values.array_types import Int32, UInt8

if TYPE_CHECKING:
    from cprl.commons.river import RiverArrays
    from cprl.commons.tables import Tables
    from cprl.commons.world import Scratch, Worlds
    from cprl.institutions import Law

CLASS_SHIFT = 24
"""The lowest bit of the class in a paint; the 24 bits below hold the colour."""
LARGEST_CLASS = 255
"""The largest class that fits into a paint."""


def class_of(paint: int) -> int:
    """Return the class of a paint."""
    return (paint >> CLASS_SHIFT) & LARGEST_CLASS


def paint_apples(world: Worlds, tables: Tables, picture: Int32) -> None:
    """Paint ground, walls, the river and apples; `picture`: int32 [cells].

    The rows of the rim, which are most of the picture of a small board, stay as `empty_scratch` painted them.
    """
    board_begin = tables.rim * tables.stride
    board_end = picture.shape[0] - board_begin
    board = picture[board_begin:board_end]
    background = tables.background[board_begin:board_end]
    for cell in range(board.shape[0]):
        board[cell] = background[cell]
    paint_waste(tables, world.groups.river, picture)
    apple = tables.paints[APPLE]
    ground = tables.paints[GROUND]
    for site in range(world.stock.shape[0]):
        picture[tables.site_cell[site]] = apple if shows_apple(world, world.groups.quirks, site) else ground


def paint_waste(tables: Tables, river: RiverArrays | None, picture: Int32) -> None:
    """Paint the cells of the river that have waste."""
    if river is not None:
        for river_cell in range(river.waste.shape[0]):
            if river.waste[river_cell] == 1:
                picture[river.board_cell[river_cell]] = tables.paints[WASTE]


def has_apple_ahead(world: Worlds, tables: Tables, agent: int) -> bool:
    """Return whether the picture has an apple on the cell ahead of an agent, even if something covers it."""
    heading = world.heading[agent]
    cell = cell_of(world.row[agent] + ROW_STEP[heading], world.col[agent] + COL_STEP[heading], tables)
    site = tables.site_at[cell]
    return site >= 0 and shows_apple(world, world.groups.quirks, site)


def mark_cell(world: Worlds, tables: Tables, agent: int) -> int:
    """Return the cell on which an agent's heading mark is painted."""
    heading = world.heading[agent]
    ahead = mark_ahead(heading, world.groups.quirks)
    row = world.row[agent] + ahead * ROW_STEP[heading]
    col = world.col[agent] + ahead * COL_STEP[heading]
    return cell_of(row, col, tables)


def is_open_ground(kind: int) -> bool:
    """Return whether marks and beams cover cells of a class: ground and clean water."""
    return kind in (GROUND, WATER)


def paint_mark(world: Worlds, tables: Tables, agent: int, picture: Int32) -> None:
    """Paint the heading mark of an agent, only on open ground, or under `Quirks2019.paint_over` on anything
    but a wall."""
    cell = mark_cell(world, tables, agent)
    kind = class_of(picture[cell])
    if is_open_ground(kind) or (paints_over(world.groups.quirks) and kind != WALL):
        picture[cell] = tables.paints[MARK]


def paint_beam(world: Worlds, tables: Tables, shooter: int, kind_of_beam: int, picture: Int32) -> None:
    """Paint the beam of a shooter, only over open ground and marks, or under `Quirks2019.paint_over` over
    everything; `kind_of_beam`: BEAM or CLEANING."""
    for side in range(-tables.beam_half_width, tables.beam_half_width + 1):
        last = beam_reach(world, tables, shooter, side, world.on_board)
        for ahead in range(beam_begin(tables, side), last + 1):
            cell = beam_cell(world, tables, shooter, ahead, side)
            kind = class_of(picture[cell])
            if paints_over(world.groups.quirks) or kind == MARK or is_open_ground(kind):
                picture[cell] = tables.paints[kind_of_beam]


def paint_of(tables: Tables, agent: int) -> int:
    """Return the paint of an agent in the windows of other agents."""
    return tables.paints[FIRST_AGENT + agent if tables.agents_apart else OTHER]


def paint_agents(world: Worlds, tables: Tables, picture: Int32) -> None:
    """Paint heading marks, then beams, then agents."""
    agents = world.row.shape[0]
    for agent in range(agents):
        if world.on_board[agent]:
            paint_mark(world, tables, agent, picture)
    paint_beams(world, tables, picture)
    for agent in range(agents):
        if world.on_board[agent]:
            picture[cell_of(world.row[agent], world.col[agent], tables)] = paint_of(tables, agent)


def paint_beams(world: Worlds, tables: Tables, picture: Int32) -> None:
    """Paint the beams with which agents fired, and those with which they cleaned."""
    for agent in range(world.row.shape[0]):
        if world.fired[agent]:
            paint_beam(world, tables, agent, BEAM, picture)
        if is_cleaning(world.groups.river, agent):
            paint_beam(world, tables, agent, CLEANING, picture)


def paint_agents_over(world: Worlds, tables: Tables, picture: Int32) -> None:
    """Paint as the program of 2019 does: each agent's mark and body cover earlier ones, beams cover all."""
    for agent in range(world.row.shape[0]):
        if world.on_board[agent]:
            paint_mark(world, tables, agent, picture)
            picture[cell_of(world.row[agent], world.col[agent], tables)] = paint_of(tables, agent)
    paint_beams(world, tables, picture)


def paint(world: Worlds, tables: Tables, picture: Int32) -> None:
    """Paint the whole board, with every agent as other agents see it."""
    paint_apples(world, tables, picture)
    if paints_over(world.groups.quirks):
        paint_agents_over(world, tables, picture)
    else:
        paint_agents(world, tables, picture)


def copy_window(world: Worlds, tables: Tables, agent: int, scratch: Scratch) -> None:
    """Copy the part of the picture that an agent observes into `scratch.seen`, the farthest row first."""
    heading = world.heading[agent]
    origin = 0 if tables.sees_all else cell_of(world.row[agent], world.col[agent], tables)
    to_cell = tables.window_cells[heading]
    for window_cell in range(to_cell.shape[0]):
        scratch.seen[window_cell] = scratch.picture[np.uint64(origin + to_cell[window_cell])]


def cut_window(world: Worlds, tables: Tables, agent: int, scratch: Scratch, window: UInt8) -> None:
    """Write the observation of an agent into `window`, uint8 [C, X, Y].

    The agent itself is in the middle of the last row, or `window_rows_behind` rows above that.
    """
    # Two passes, so that the second writes contiguous memory, and unsigned indices in `copy_window`, so that
    # Numba does not check for negative ones: three times as fast as a plain loop (`benchmarks/env_steps.py`).
    copy_window(world, tables, agent, scratch)
    cells = tables.window_cells.shape[1]
    planes = window.reshape(-1)
    if tables.one_hot:
        for window_cell in range(cells):
            scratch.seen[window_cell] = tables.channel_of[class_of(scratch.seen[window_cell])]
        for channel in range(window.shape[0]):
            for window_cell in range(cells):
                planes[channel * cells + window_cell] = (
                    scratch.seen[window_cell] == channel
                ) * tables.highest
    else:
        for window_cell in range(cells):
            colour = scratch.seen[window_cell]
            planes[window_cell] = colour & 255
            planes[cells + window_cell] = (colour >> 8) & 255
            planes[2 * cells + window_cell] = (colour >> 16) & 255


def draw_windows(world: Worlds, tables: Tables, scratch: Scratch, observation: UInt8) -> None:
    """Write the observations of all agents, each sees itself as SELF; `observation`: uint8 [N, C, X, Y]."""
    picture = scratch.picture
    paint(world, tables, picture)
    for agent in range(world.row.shape[0]):
        cell = cell_of(world.row[agent], world.col[agent], tables)
        paint_for_others = picture[cell]
        picture[cell] = tables.paints[SELF]
        cut_window(world, tables, agent, scratch, observation[agent])
        if not self_stays(world.groups.quirks):
            picture[cell] = paint_for_others


def draw_board(world: Worlds, tables: Tables, scratch: Scratch, board: UInt8) -> None:
    """Write the classes of all cells of the board, without its rim; `board`: uint8 [H, W]."""
    paint(world, tables, scratch.picture)
    for row in range(board.shape[0]):
        for col in range(board.shape[1]):
            board[row, col] = class_of(scratch.picture[cell_of(row, col, tables)])


HIGHEST = 255
"""The largest value in the planes of scores and institutions."""


def draw_scores(world: Worlds, tables: Tables, observation: UInt8) -> None:
    """Write the planes of the scoreboard and of the stock gauge, see `Observation`.

    `observation`: uint8 [N, C, X, Y].
    """
    agents = world.row.shape[0]
    sites = world.stock.shape[0]
    end = tables.scoreboard_cells + tables.stock_gauge_cells
    stock = in_bytes(world.stock_left[0], sites)
    for agent in range(agents):
        planes = observation[agent].reshape(-1)[tables.score_begin :]
        for plane_cell in range(min(agents, tables.scoreboard_cells)):
            harvest = world.harvested[(agent + plane_cell) % agents]
            planes[plane_cell] = in_bytes(harvest, harvest + sites)
        for plane_cell in range(agents, tables.scoreboard_cells):
            planes[plane_cell] = planes[plane_cell - agents]
        for plane_cell in range(tables.scoreboard_cells, end):
            planes[plane_cell] = stock


def in_bytes(part: int, whole: int) -> int:
    """Return the share part / whole as 0..255, rounded half up.

    Integers alone are used, so that the result is the same on every device.
    """
    return (2 * HIGHEST * part + whole) // (2 * whole)


def draw_institutions(world: Worlds, tables: Tables, law: Law, observation: UInt8) -> None:
    """Write the planes of institutions; `observation`: uint8 [N, C, X, Y]."""
    cells = tables.window_cells.shape[1]
    for agent in range(world.row.shape[0]):
        planes = observation[agent].reshape(-1)
        first = cells * law.entries.first_plane
        if law.entries.shows_places:
            draw_forbidden(world, tables, law, agent, planes[first : first + cells])
            first += cells
        if law.entries.entry.shape[0] > 0:
            draw_entries(law, agent, world.step[0], planes[first:])


def draw_forbidden(world: Worlds, tables: Tables, law: Law, agent: int, plane: UInt8) -> None:
    """Write the plane of the cells where a harvest of an agent would break a rule; `plane`: uint8 [X * Y]."""
    origin = 0 if tables.sees_all else cell_of(world.row[agent], world.col[agent], tables)
    heading = world.heading[agent]
    for window_cell in range(plane.shape[0]):
        cell = origin + tables.window_cells[heading, window_cell]
        plane[window_cell] = HIGHEST if is_seen_as_forbidden(law, agent, cell, tables.site_at[cell]) else 0


def draw_entries(law: Law, agent: int, turn: int, planes: UInt8) -> None:
    """Write the S entries that institutions show an agent, each into every S-th cell; `planes`: uint8, one
    axis."""
    entries = law.entries.entry.shape[0]
    for entry in range(entries):
        value = int(HIGHEST * min(1.0, max(0.0, shown_value(law, entry, agent, turn))) + 0.5)
        for plane_cell in range(entry, planes.shape[0], entries):
            planes[plane_cell] = value
