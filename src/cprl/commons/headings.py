"""The four headings of agents, and the step from a cell to the next one ahead."""

from typing import Final

UP, RIGHT, DOWN, LEFT = range(4)
"""The headings in clockwise order: adding 1 modulo 4 turns right by 90 degrees."""

ROW_STEP: Final = (-1, 0, 1, 0)
COL_STEP: Final = (0, 1, 0, -1)
"""The change of row and of column from a cell to the next one ahead, by heading."""
