"""Headings, and the step to the next cell ahead."""

from typing import Final

UP, RIGHT, DOWN, LEFT = 0, 1, 2, 3
"""Headings; adding one turns right by 90 degrees."""

ROW_STEP: Final = (-1, 0, 1, 0)
COL_STEP: Final = (0, 1, 0, -1)
"""The step to the next cell ahead, indexed by heading."""
