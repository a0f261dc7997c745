"""Boards: drawn (`parse`), by name (`named`), or generated (`crosses`, `rooms`, `random`)."""

from cprl.commons.maps.board import HEADING_OF_SIGN, SIGN_OF_HEADING, Cell, Map, Start
from cprl.commons.maps.drawings import NAMES, named, parse
from cprl.commons.maps.generators import ROOM_NAMES, crosses, random, room_cells, rooms

__all__ = [
    "HEADING_OF_SIGN",
    "NAMES",
    "ROOM_NAMES",
    "SIGN_OF_HEADING",
    "Cell",
    "Map",
    "Start",
    "crosses",
    "named",
    "parse",
    "random",
    "room_cells",
    "rooms",
]
