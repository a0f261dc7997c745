"""The arrays of B worlds: their state, the output of a step, and working memory.

The rules are written for one world, and get these named tuples of arrays without the axis B.
"""

import sys
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np

from cprl.commons.chance import SITES_PER_DRAW
from cprl.commons.rules import GROUP_ARRAYS, RuleGroups
from cprl.institutions.arrays import DERIVED, IN_STATE, STEPS, InState, filled, forms_of
from cprl.values.array_types import Bool, Float32, Int32, Int64, UInt8, UInt32, UInt64

if TYPE_CHECKING:
    from cprl.commons.game import Game


PLAYING, TERMINATED, TRUNCATED = range(3)
"""The status of a world's episode: it goes on; it ended as no apple is left and none can grow; time is up."""

PLAY, BEGIN, REFRESH = range(3)
"""The tasks of the loop over worlds: play a turn, begin the next episode, or write the output that belongs to
a state that was set from outside."""


class Worlds(NamedTuple):
    """The state of B worlds of N agents and K sites."""

    seed: Annotated[UInt64, "B 1", InState(high=2**64 - 1, cleared=False)]
    """All random numbers of a world follow from its seed, number, episode and step."""
    number: Annotated[UInt64, "B 1", InState(high=2**32 - 1, cleared=False)]
    """The index of this world among all worlds of its seed; below 2**32."""
    stock: Annotated[UInt8, "B K", InState(high=1, cleared=False)]
    """1 where a site holds an apple."""
    near: Annotated[UInt32, "B K", DERIVED]
    """The number of apples near each site."""
    stock_left: Annotated[Int32, "B 1", DERIVED]
    """The sum of `stock`."""
    row: Annotated[Int32, "B N", InState(high="last_row", cleared=False)]
    """0 is the top row."""
    col: Annotated[Int32, "B N", InState(high="last_col", cleared=False)]
    """0 is the leftmost column."""
    heading: Annotated[Int32, "B N", InState(high=3, cleared=False)]
    """0 up, 1 right, 2 down, 3 left."""
    out_steps: Annotated[Int32, "B N", IN_STATE]
    """The number of turns that the agent still misses."""
    in_play: Annotated[Bool, "B N", InState(cleared=False)]
    """True for agents that act in the coming turn."""
    on_board: Annotated[Bool, "B N", InState(cleared=False)]
    """True for agents that were in play at the end of the last turn, before others returned to play."""
    fired: Annotated[Bool, "B N", IN_STATE]
    """True for agents that fired in the last turn."""
    shot_row: Annotated[Int32, "B N", InState(high="last_row")]
    """The row from which the agent last fired or cleaned."""
    shot_col: Annotated[Int32, "B N", InState(high="last_col")]
    """The column from which the agent last fired or cleaned."""
    shot_heading: Annotated[Int32, "B N", InState(high=3)]
    """The heading in which the agent last fired or cleaned."""
    cooldown: Annotated[Int32, "B N", InState(high="cooldown_steps")]
    """The number of turns in play in which the agent still cannot fire."""
    signal: Annotated[Int32, "B N", InState(high="signals")]
    """The signal that the agent sent in the last turn, counted from 1; 0 for none."""
    hits: Annotated[Int32, "B N", InState(high="most_hits")]
    """The number of hits since the agent was last tagged."""
    tagged_step: Annotated[Int32, "B N", STEPS]
    """The step at which the agent was last tagged; 0 for never."""
    offences: Annotated[Int32, "B N", IN_STATE]
    """The number of times that the agent was tagged in this episode."""
    harvested: Annotated[Int32, "B N", STEPS]
    """The apples that the agent has harvested in this episode."""
    step: Annotated[Int32, "B 1", STEPS]
    """The number of turns played in this episode."""
    episode: Annotated[Int32, "B 1", InState(low=-1, cleared=False)]
    """The index of the episode since the seed was set; -1 before the first."""
    ended: Annotated[Int32, "B 1", InState(high=TRUNCATED)]
    """PLAYING, TERMINATED or TRUNCATED."""
    groups: RuleGroups
    """The arrays of the groups of rules that the game has."""


class StepOutput(NamedTuple):
    """The output of a turn, in arrays that the caller provides, usually memory of torch tensors.

    `cprl.keys` describes the entries of these names. An entry that a game lacks has length 0.
    """

    observation: Annotated[UInt8, "B N C X Y"]
    reward: Annotated[Float32, "B N"]
    harvest: Annotated[Float32, "B N"]
    in_play: Annotated[Bool, "B N"]
    fired: Annotated[Bool, "B N"]
    hit_by: Annotated[Bool, "B N N"]
    tagged_by: Annotated[Bool, "B N N"]
    apple_ahead: Annotated[Bool, "B N U"]
    """U is 1 with `Quirks2019.paint_over`, else 0."""
    waste: Annotated[Int64, "B P"]
    """P is 1, or 0 without a river."""
    cleaned: Annotated[Float32, "B M"]
    """M is N, or 0 without a river."""
    stock: Annotated[Int64, "B 1"]
    regrown: Annotated[Int64, "B 1"]
    terminated: Annotated[Bool, "B 1"]
    truncated: Annotated[Bool, "B 1"]
    done: Annotated[Bool, "B 1"]
    fines: Annotated[Float32, "B L"]
    """L is N, or 0 without institutions."""
    transfers: Annotated[Float32, "B L"]
    violated: Annotated[Bool, "B L"]
    counts: Annotated[Int32, "B L counts"]
    """A number for each of `cprl.institutions.COUNT_NAMES`."""
    in_force: Annotated[Float32, "B F"]
    """F is the number of `Game.in_force`."""
    ballots_due: Annotated[Bool, "B V"]
    """V is the number of ballots."""


class Scratch(NamedTuple):
    """Working memory for one turn. Each thread has one, since the rules allocate nothing."""

    start_row: Annotated[Int32, "N"]
    """The row in which each agent began the turn."""
    start_col: Annotated[Int32, "N"]
    """The column in which each agent began the turn."""
    order: Annotated[Int32, "N"]
    """A permutation of the agents, drawn by chance: the order in which they move under the clash rule
    "in_turn", or the rank of each agent under "one_moves"."""
    blocked: Annotated[Bool, "N"]
    """True for agents whose move, or return to play, is being cancelled."""
    words: Annotated[Int64, "words"]
    """Random 32-bit words; each has the first bytes of four sites. Their number is K / 4, rounded up to a
    multiple of 4."""
    sprouts: Annotated[Int32, "K"]
    """The indices of the sites that grow an apple in this turn, followed by entries without meaning."""
    picture: Annotated[Int32, "cells"]
    """The board with a rim of wall around it, as paints, see `Tables.paints`. Nothing paints over the rim."""
    seen: Annotated[Int32, "window"]
    """The paints of the X * Y cells of the window that is being written."""


class WorldView(NamedTuple):
    """A copy of one world for display, as numpy arrays. Entries without a docstring are those of `Worlds`."""

    observation: UInt8
    """uint8 [N, C, X, Y], the observation of each agent."""
    board: UInt8
    """uint8 [H, W], the class of each cell, see `cprl.commons.cells`."""
    stock: UInt8
    row: Int32
    col: Int32
    heading: Int32
    in_play: Bool
    harvested: Int32


def empty_worlds(game: "Game", worlds: int) -> Worlds:
    """Return the arrays of B worlds before their first episode: `episode` is -1, everything else is 0."""
    sizes = {"B": worlds, "N": game.agents, "K": len(game.map.sites), "R": len(game.map.river)}
    groups: Any = RuleGroups._make(_empty_group(game, name, sizes) for name in RuleGroups._fields)
    empty = filled(Worlds, {"groups": groups}, **sizes)
    empty.episode[:] = -1
    return empty


def _empty_group(game: "Game", name: str, sizes: dict[str, int]) -> Any:
    """Return the arrays of a group of rules for new worlds; None if the game lacks the group."""
    if not getattr(game.rules, name):
        return None
    kind = GROUP_ARRAYS[name]
    return filled(kind, sys.modules[kind.__module__].parameters(game), **sizes)


CACHE_LINE_BYTES = 128
"""The number of unused entries after each array of a Scratch. Without them, arrays of different threads could
share a cache line of the processor, which slows both threads down."""


def empty_scratch(game: "Game") -> Scratch:
    """Return the working memory of one thread: all zero, except the picture, which shows an empty board."""
    sites = len(game.map.sites)
    forms = forms_of(
        Scratch,
        N=game.agents,
        K=sites,
        words=4 * -(-sites // SITES_PER_DRAW),
        cells=game.tables.background.size,
        window=game.tables.window_cells.shape[1],
    )
    arrays: list[Any] = [
        np.zeros(length + CACHE_LINE_BYTES, dtype)[:length] for (length,), dtype in forms.values()
    ]
    scratch = Scratch(*arrays)
    scratch.picture[:] = game.tables.background
    return scratch
