"""What institutions add to agents' observations, on one world: further planes after the channels of cells.

A plane "forbidden" is 255 on the cells of the window where a bite of the agent would break a rule about
places. Planes "institutions" hold what `cprl.institutions.showing` lists, in 0..255: with S entries, cell n
of the planes, row by row, shows entry n modulo S. So a single entry fills a plane evenly, as is usual for
numbers that convolutions read beside a board.
"""

from cprl.commons.moves import cell_of
from cprl.commons.tables import Tables
from cprl.commons.world import Bytes, Worlds
from cprl.institutions.limits import is_known_forbidden
from cprl.institutions.memory import InstitutionTables, Memory
from cprl.institutions.showing import shown_entry

HIGHEST = 255


def is_shown_forbidden(
    world: Worlds, memory: Memory, tables: Tables, rules: InstitutionTables, i: int, window_cell: int
) -> bool:
    """Whether agent i sees that a bite on a cell of its window would break a rule about places."""
    own = 0 if tables.sees_all else cell_of(world.row[i], world.col[i], tables)
    heading = world.heading[i]
    if tables.walls_block_sight and not tables.in_sight[own, heading, window_cell]:
        return False
    cell = own + tables.window_cells[heading, window_cell]
    return is_known_forbidden(memory, rules, i, cell, tables.site_at[cell])


def draw_forbidden(
    world: Worlds, memory: Memory, tables: Tables, rules: InstitutionTables, i: int, plane: Bytes
) -> None:
    """Draws where bites of agent i are forbidden; `plane`: uint8 [X * Y]."""
    for n in range(plane.shape[0]):
        plane[n] = HIGHEST if is_shown_forbidden(world, memory, tables, rules, i, n) else 0


def draw_entries(memory: Memory, rules: InstitutionTables, i: int, turn: int, planes: Bytes) -> None:
    """Writes the entries shown to agent i, each into every S-th cell; `planes`: uint8 [cells]."""
    entries = rules.shown_kind.shape[0]
    for entry in range(entries):
        level = shown_entry(memory, rules, i, entry, turn)
        value = int(HIGHEST * min(1.0, max(0.0, level)) + 0.5)
        for n in range(entry, planes.shape[0], entries):
            planes[n] = value


def draw_institutions(
    world: Worlds, memory: Memory, tables: Tables, rules: InstitutionTables, observation: Bytes
) -> None:
    """Writes what institutions show each agent; `observation`: uint8 [N, C, X, Y]."""
    cells = tables.window_cells.shape[1]
    for i in range(world.row.shape[0]):
        planes = observation[i].reshape(-1)
        first = cells * rules.first_plane
        if rules.shows_places:
            draw_forbidden(world, memory, tables, rules, i, planes[first : first + cells])
            first += cells
        if rules.shown_kind.shape[0] > 0:
            draw_entries(memory, rules, i, world.step[0], planes[first:])
