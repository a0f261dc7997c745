"""Observation: what agents observe of the game, and in which form."""

from dataclasses import dataclass
from typing import Literal

from cprl.values import Value

Area = Literal["window", "full"]
Encoding = Literal["rgb", "one_hot"]


@dataclass(frozen=True, kw_only=True)
class Observation(Value):
    """The form of every agent's observation; defaults are those of both studies."""

    area: Area = "window"
    """"window": the cells ahead, `Rules.window_rows` x `Rules.window_columns`, rotated with the agent;
    "full": the whole board, not rotated, row 0 at the top, with the observer shown as "self"."""

    encoding: Encoding = "rgb"
    """"rgb": red, green and blue, 0..255; "one_hot": a channel for each class of cell, 0 or 1."""

    agents_apart: bool = False
    """Whether each other agent has its own colour or channel; otherwise all other agents look the same."""

    scoreboard: bool = False
    """Whether each agent also observes every agent's harvest in this episode, its own first, in further
    channels. Cell n of them, row by row, shows entry n modulo N: of h apples 255 h / (h + K), rounded, on a
    board of K sites. So an agent with as many apples as the board has sites shows half of 255, and no harvest
    exceeds 255."""

    stock_gauge: bool = False
    """Whether each agent also observes the share of all sites that hold an apple, in a further channel:
    everywhere 255 times the share, rounded."""

    @property
    def highest(self) -> int:
        """The largest value of an entry: 255 for "rgb", 1 for "one_hot"."""
        return 255 if self.encoding == "rgb" else 1
