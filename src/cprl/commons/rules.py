"""Rules: every number and switch of the game, with its unit, range and source.

Sources: [W] M. Wiatrak, "Governing the Commons with Multi-Agent Reinforcement Learning" (2019);
[P] Perolat et al. (2017); [run] the program that produced the results of [W], where it differs from the text.
`docs/game.md` describes the game in words.
"""

from dataclasses import dataclass, fields
from typing import Annotated, Final, Literal

from cprl.values import MOST_INT32, Odd, Positive, Range, Value, Where

ACTIONS: Final = ("forward", "backward", "left", "right", "turn_left", "turn_right", "beam", "stay")
"""The actions by index. If no agent may fire, there is no "beam", and 6 is "stay"."""

Norm = Literal["euclidean", "manhattan", "chebyshev"]

LARGEST_WINDOW_CELLS: Final = 1000
"""The largest number of rows or columns of a window."""
SMALLEST_PROBABILITY: Final = 2**-32
"""Chance is compared in 32 bits: a smaller probability could never come true, or would be rounded up."""

Probability = Annotated[
    float,
    Where(
        lambda value: value == 0 or SMALLEST_PROBABILITY <= value <= 1,
        "a number that is 0, or 2**-32 (2.3e-10) to 1",
    ),
]
Window = Annotated[int, Range(1, LARGEST_WINDOW_CELLS)]


@dataclass(frozen=True, kw_only=True)
class Rules(Value):
    """The numbers of a game.

    Defaults are those of `published`: every quirk of the study as run is off. Lists and arrays are stored as
    tuples, so that rules can be compared, hashed and printed.
    """

    regrow_prob: Annotated[
        tuple[Probability, ...],
        Where(
            lambda probabilities: len(probabilities) > 0,
            "one or more numbers, each 0 or 2**-32 (2.3e-10) to 1",
        ),
    ] = (0.0, 0.01, 0.01, 0.05, 0.05, 0.1)
    """Probability per turn that an empty site grows an apple, indexed by the number of apples near it [W];
    the last entry also applies to every larger number.

    With K sites, growth is logistic in the stock by `tuple(r * s / K for s in range(K + 1))` and
    `regrow_radius_cells=1000`."""

    regrow_radius_cells: Annotated[float, Range(0, 1000)] = 2.0
    """The distance up to which apples count as near, in cells, measured by `regrow_norm`, inclusive [W]."""

    regrow_norm: Norm = "euclidean"
    """The norm that measures this distance [W]."""

    beam_length_cells: Positive | tuple[Positive, Positive, Positive, Positive] = 5
    """The length of a beam in cells: one number, or four by heading (up, right, down, left)."""

    beam_width_cells: Odd = 3
    """The width of a beam in cells [W]."""

    hits_to_tag: Positive = 1
    """The hits, at most one per turn, after which an agent is tagged [W]; 2 in [run]."""

    freeze_steps: Annotated[
        int,
        Where(
            lambda steps: 0 <= steps <= MOST_INT32,
            "an integer >= 0; by shooter or by offence with cprl.institutions.GraduatedSanctions",
        ),
    ] = 25
    """The number of turns that a tagged agent misses [W]; by shooter or by offence with
    `cprl.institutions.GraduatedSanctions`."""

    may_fire: bool = True
    """Whether agents may fire; if not, there is no beam action. For some agents alone:
    `cprl.institutions.Sanctioner`."""

    window_rows: Window = 6
    """The rows of a window: the agent's own and those ahead of it [W]."""

    window_columns: Annotated[
        int,
        Where(
            lambda columns: 1 <= columns <= LARGEST_WINDOW_CELLS and columns % 2 == 1,
            f"an odd integer from 1 to {LARGEST_WINDOW_CELLS}",
        ),
    ] = 13
    """The columns of a window, the agent's own in the middle [W]."""

    walls_block_sight: bool = False
    """Whether a window shows only cells in line of sight, that is, the straight line between the two cell
    centres crosses the interior of no wall (ours)."""

    episode_steps: Positive = 1000
    """The number of turns after which an episode is truncated [W]."""

    shuffle_starts: bool = False
    """Whether each episode permutes the agents' starts, all permutations equally likely (ours)."""

    pairwise_clashes: bool = False
    """[run] All agents move at once. Then, pair by pair in the order of agent indices, two agents on one
    cell, or two that swapped, both go back to where they began the turn, even if a third agent stands there.
    Agents out of play return at once, even onto an occupied cell."""

    regrow_before_bites: bool = False
    """[run] Apples grow before agents harvest, so an apple can grow and be harvested in the same turn."""

    freeze_counts_tag_turn: bool = False
    """[run] The turn of the tag counts as the first of `freeze_steps`, so the agent misses one turn less."""

    ends_one_turn_late: bool = False
    """[run] The episode terminates in the turn that begins with an empty stock, one turn later."""

    picture_shows_old_stock: bool = False
    """[run] The picture shows the apples of the start of the turn."""

    paint_over: bool = False
    """[run] Heading marks cover apples and agents of lower indices; beams cover everything."""

    mark_behind_if_vertical: bool = False
    """[run] The heading mark of an agent that faces up or down is painted behind the agent."""

    self_paint_stays: bool = False
    """[run] Windows are drawn in the order of agent indices; each agent's cell is painted as "self" and
    stays so in the windows of later agents, whether the agent is in play or not."""

    agent_1_right_moves_agent_0: bool = False
    """[run] The action "right" of agent 1 moves agent 0 in its place, to the right of agent 0's own heading,
    after agent 0's own action and even while agent 0 is out of play; a beam that agent 0 fires in this turn
    begins where it fired. A fault of the program for two agents until 13 April 2019. At least two agents."""

    def __repr__(self) -> str:
        pairs = ((field, getattr(self, field.name)) for field in fields(self))
        changed = [f"{field.name}={value!r}" for field, value in pairs if value != field.default]
        return f"Rules({', '.join(changed)})"

    @property
    def beam_lengths_cells(self) -> tuple[int, int, int, int]:
        """`beam_length_cells` by heading: up, right, down, left."""
        length = self.beam_length_cells
        return length if isinstance(length, tuple) else (length,) * 4

    @property
    def actions(self) -> tuple[str, ...]:
        """The names of the actions, by index: 8 of them, or 7 without a beam."""
        return ACTIONS if self.may_fire else tuple(name for name in ACTIONS if name != "beam")
