"""The arrays of B worlds: their state, the output of a step, and scratch memory.

The rules are written for one world: they receive these tuples without the axis B.
"""

from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np

from cprl.commons.chance import SITES_PER_DRAW
from cprl.commons.rules import GROUPS, Groups
from cprl.institutions.arrays import DERIVED, STATE, STEPS, Kept, filled, forms_of
from cprl.values.arrays import Bool, Float32, Int32, Int64, UInt8, UInt32, UInt64

if TYPE_CHECKING:
    from cprl.commons.game import Game


PLAYING, TERMINATED, TRUNCATED = 0, 1, 2
"""The status of a world: still playing; no apple is left and none can grow; out of time."""

PLAY, BEGIN, REFRESH = 0, 1, 2
"""What the loop over worlds does with each: play a turn; begin the next episode; write the output of a state
that was set from outside."""


class Worlds(NamedTuple):
    """The state of B worlds of N agents and K sites."""

    seed: Annotated[UInt64, "B 1", Kept(high=2**64 - 1, cleared=False)]
    """All random numbers of a world follow from its seed, number, episode and step."""
    number: Annotated[UInt64, "B 1", Kept(high=2**32 - 1, cleared=False)]
    """The index of this world among all worlds of its seed; below 2**32."""
    stock: Annotated[UInt8, "B K", Kept(high=1, cleared=False)]
    """1 where a site holds an apple."""
    near: Annotated[UInt32, "B K", DERIVED]
    """The number of apples near each site."""
    stock_left: Annotated[Int32, "B 1", DERIVED]
    """The sum of `stock`."""
    row: Annotated[Int32, "B N", Kept(high="last_row", cleared=False)]
    """0 is the top row."""
    col: Annotated[Int32, "B N", Kept(high="last_col", cleared=False)]
    """0 is the leftmost column."""
    heading: Annotated[Int32, "B N", Kept(high=3, cleared=False)]
    """0 up, 1 right, 2 down, 3 left."""
    out_steps: Annotated[Int32, "B N", STATE]
    """The number of turns that the agent still has to miss."""
    in_play: Annotated[Bool, "B N", Kept(cleared=False)]
    """Whether the agent acts in the coming turn."""
    on_board: Annotated[Bool, "B N", Kept(cleared=False)]
    """Whether the agent was in play at the end of the last turn, before those returned that had missed
    turns."""
    fired: Annotated[Bool, "B N", STATE]
    """Whether the agent fired in the last turn."""
    shot_row: Annotated[Int32, "B N", Kept(high="last_row")]
    """The row from which the agent last fired or cleaned."""
    shot_col: Annotated[Int32, "B N", Kept(high="last_col")]
    """The column from which it did."""
    shot_heading: Annotated[Int32, "B N", Kept(high=3)]
    """The heading in which it did."""
    cooldown: Annotated[Int32, "B N", Kept(high="cooldown_steps")]
    """The number of turns in play in which the agent cannot fire."""
    signal: Annotated[Int32, "B N", Kept(high="signals")]
    """The signal that the agent sent in the last turn; 0 for none."""
    hits: Annotated[Int32, "B N", Kept(high="most_hits")]
    """Hits since the last tag."""
    tagged_step: Annotated[Int32, "B N", STEPS]
    """The step at which the agent was last tagged; 0 for never."""
    offences: Annotated[Int32, "B N", STATE]
    """How often the agent was tagged in this episode."""
    harvested: Annotated[Int32, "B N", STEPS]
    """Apples harvested in this episode."""
    step: Annotated[Int32, "B 1", STEPS]
    """Turns played in this episode."""
    episode: Annotated[Int32, "B 1", Kept(low=-1, cleared=False)]
    """The index of the episode since the seed was set; -1 before the first."""
    ended: Annotated[Int32, "B 1", Kept(high=TRUNCATED)]
    """PLAYING, TERMINATED or TRUNCATED."""
    groups: Groups


class StepOutput(NamedTuple):
    """The output of a turn, written into arrays that the caller provides (usually torch memory): the entries
    of these names in `cprl.keys`, which says what each means. An entry that a game lacks has length 0."""

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
    """A number for each of `cprl.institutions.COUNTS`."""
    in_force: Annotated[Float32, "B V"]
    """V is the number of ballots."""
    ballots_due: Annotated[Bool, "B V"]


class Scratch(NamedTuple):
    """Working memory for one turn, one per thread: the rules allocate nothing."""

    start_row: Annotated[Int32, "N"]
    """The row in which each agent began the turn."""
    start_col: Annotated[Int32, "N"]
    """The column in which each agent began the turn."""
    order: Annotated[Int32, "N"]
    """A permutation of the agents: the order in which they move, or the rank of each; see `Rules.clashes`."""
    blocked: Annotated[Bool, "N"]
    """Whether the agent's move is being cancelled, or its return to play."""
    words: Annotated[Int64, "words"]
    """Random 32-bit words, K / 4 rounded up to a multiple of 4; one word serves four sites."""
    sprouts: Annotated[Int32, "K"]
    """The sites that grow an apple in this turn come first."""
    picture: Annotated[Int32, "cells"]
    """The board and a rim of wall around it, as paints (see `Tables.paints`); nothing paints over the rim."""
    seen: Annotated[Int32, "window"]
    """The paints of the window being written, X * Y of them."""


class Shown(NamedTuple):
    """One world for display: copies, as numpy arrays. Entries without a docstring are those of `Worlds`."""

    observation: UInt8
    """uint8 [N, C, X, Y], what each agent observes."""
    board: UInt8
    """uint8 [H, W], classes of `cprl.commons.cells`."""
    stock: UInt8
    row: Int32
    col: Int32
    heading: Int32
    in_play: Bool
    harvested: Int32


def empty_worlds(game: "Game", worlds: int) -> Worlds:
    """Return memory for B worlds, all zero except `episode`, which is -1; `Batch.begin` starts the first
    episode."""
    sizes = {"B": worlds, "N": game.agents, "K": len(game.map.sites), "R": len(game.map.river)}
    groups: Any = Groups._make(_empty_group(game, name, sizes) for name in Groups._fields)
    empty = filled(Worlds, {"groups": groups}, **sizes)
    empty.episode[:] = -1
    return empty


def _empty_group(game: "Game", name: str, sizes: dict[str, int]) -> Any:
    """Return the arrays of a group of rules, None if the game lacks it."""
    if getattr(game.rules, name) is None:
        return None
    module = GROUPS[name]
    return filled(module.Arrays, module.parameters(game), **sizes)


CACHE_LINE_BYTES = 128
"""Padding after each array of a Scratch, in entries: threads that share a cache line slow each other down."""


def empty_scratch(game: "Game") -> Scratch:
    """Return the working memory of one thread: zeros, but for the rim of the picture."""
    sites, cells, window = len(game.map.sites), game.tables.background.size, game.tables.window_cells.shape[1]
    words = 4 * -(-sites // SITES_PER_DRAW)
    forms = forms_of(Scratch, N=game.agents, K=sites, words=words, cells=cells, window=window)
    arrays: list[Any] = [
        np.zeros(length + CACHE_LINE_BYTES, dtype)[:length] for (length,), dtype in forms.values()
    ]
    scratch = Scratch(*arrays)
    scratch.picture[:] = game.tables.background
    return scratch
