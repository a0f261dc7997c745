"""Observation: the form in which agents observe the game."""

from dataclasses import dataclass
from typing import Literal

from cprl.values import Value

Area = Literal["window", "full"]
"""The part of the board that agents observe, see `Observation.area`."""
Encoding = Literal["rgb", "one_hot"]
"""The form of a cell in observations, see `Observation.encoding`."""


@dataclass(frozen=True, kw_only=True)
class Observation(Value):
    """The form of every agent's observation. The defaults are those of the studies of 2017 and 2019."""

    area: Area = "window"
    """"window": the agent observes the cells ahead of it, `Rules.window_rows` x `Rules.window_columns`,
    rotated with it. "full": it observes the whole board, not rotated, row 0 at the top. In both it is shown
    as "self"."""

    encoding: Encoding = "rgb"
    """"rgb": red, green and blue, 0..255; "one_hot": a channel for each class of cell, 0 or 1."""

    agents_apart: bool = False
    """Whether each other agent has its own colour or channel; otherwise all other agents look the same."""

    scoreboard: bool = False
    """Whether each agent also observes every agent's harvest in this episode, in further channels.

    The observer's own harvest is entry 0, that of the next agent entry 1, and so on. Cell n of the channels,
    counted row by row, shows entry n modulo N. On a board of K sites, a harvest of h apples is shown as
    255 h / (h + K), rounded: as half of 255 for as many apples as the board has sites, and never above
    255."""

    stock_gauge: bool = False
    """Whether each agent also observes the share of all sites that hold an apple, in a further channel. All
    cells of it show 255 times the share, rounded."""

    @property
    def highest(self) -> int:
        """Return the largest value of an entry: 255 for "rgb", 1 for "one_hot"."""
        return 255 if self.encoding == "rgb" else 1
