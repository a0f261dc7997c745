"""The arrays of B worlds: their state, the output of a step, and scratch memory.

The rules are written for one world: they receive these tuples without the axis B.
"""

from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cprl.commons.chance import SITES_PER_DRAW
from cprl.institutions.arrays import Bools as Bools
from cprl.institutions.arrays import Bytes as Bytes
from cprl.institutions.arrays import Floats as Floats
from cprl.institutions.arrays import Ints as Ints
from cprl.institutions.arrays import filled, forms_of
from cprl.institutions.ledger import Payments

if TYPE_CHECKING:
    from cprl.commons.game import Game

Indices: TypeAlias = NDArray[np.uint32]
"""Unsigned: Numba then skips its check for negative indices."""
Actions: TypeAlias = NDArray[np.int64]
Words: TypeAlias = NDArray[np.uint64]

PLAYING, TERMINATED, TRUNCATED = 0, 1, 2
"""The status of a world: still playing; no apple is left and none can grow; out of time."""

UP, RIGHT, DOWN, LEFT = 0, 1, 2, 3
"""Headings; adding one turns right by 90 degrees."""

ROW_STEP = (-1, 0, 1, 0)
COL_STEP = (0, 1, 0, -1)
"""The step to the next cell ahead, indexed by heading."""


class Worlds(NamedTuple):
    """The state of B worlds of N agents and K sites."""

    seed: Annotated[Words, "B 1"]
    """All random numbers of a world follow from its seed, number, episode and step."""
    number: Annotated[Words, "B 1"]
    """The index of this world among all worlds of its seed; below 2**32."""
    stock: Annotated[Bytes, "B K"]
    """1 where a site holds an apple."""
    stock_before: Annotated[Bytes, "B K"]
    """The stock at the start of the turn; updated only under `picture_shows_old_stock`."""
    near: Annotated[Indices, "B K"]
    """The number of apples near each site; derived from `stock`."""
    stock_left: Annotated[Ints, "B 1"]
    """The sum of `stock`; derived from it."""
    row: Annotated[Ints, "B N"]
    """0 is the top row."""
    col: Annotated[Ints, "B N"]
    """0 is the leftmost column."""
    heading: Annotated[Ints, "B N"]
    """0 up, 1 right, 2 down, 3 left."""
    out_steps: Annotated[Ints, "B N"]
    """The number of turns that the agent still has to miss."""
    in_play: Annotated[Bools, "B N"]
    """Whether the agent acts in the coming turn."""
    on_board: Annotated[Bools, "B N"]
    """Whether the agent was in play at the end of the last turn, before anyone returned."""
    fired: Annotated[Bools, "B N"]
    """Whether the agent fired in the last turn."""
    moved_after_firing: Annotated[Bools, "B N"]
    """Whether another agent then moved it by one cell to its right, so that its beam begins one cell to its
    left; only under `agent_1_right_moves_agent_0`, else all false."""
    cooldown: Annotated[Ints, "B N"]
    """The number of turns in play in which the agent cannot fire; only under `cooldown_steps`, else all 0."""
    signal: Annotated[Ints, "B N"]
    """The signal that the agent sent in the last turn; 0 for none."""
    cleans: Annotated[Bools, "B N"]
    """Whether the agent cleaned in the last turn; only under `may_clean`, else all false."""
    waste: Annotated[Bytes, "B R"]
    """1 where a cell of the river has waste."""
    waste_left: Annotated[Ints, "B 1"]
    """The sum of `waste`; derived from it."""
    hits: Annotated[Ints, "B N"]
    """Hits since the last tag."""
    tagged_step: Annotated[Ints, "B N"]
    """The step at which the agent was last tagged; 0 for never."""
    offences: Annotated[Ints, "B N"]
    """How often the agent was tagged in this episode."""
    harvested: Annotated[Ints, "B N"]
    """Apples harvested in this episode."""
    step: Annotated[Ints, "B 1"]
    """Turns played in this episode."""
    episode: Annotated[Ints, "B 1"]
    """The index of the episode since the seed was set; -1 before the first."""
    ended: Annotated[Ints, "B 1"]
    """PLAYING, TERMINATED or TRUNCATED."""


class StepOutput(NamedTuple):
    """The output of a turn, written into arrays that the caller provides (usually torch memory): the entries
    of these names in `cprl.keys`, which says what each means."""

    observation: Annotated[Bytes, "B N C X Y"]
    harvest: Annotated[Floats, "B N"]
    in_play: Annotated[Bools, "B N"]
    fired: Annotated[Bools, "B N"]
    hit_by: Annotated[Bools, "B N N"]
    tagged_by: Annotated[Bools, "B N N"]
    scoreboard: Annotated[Floats, "B N S"]
    """S is N, or 0 without a scoreboard."""
    stock_gauge: Annotated[Floats, "B N G"]
    """G is 1, or 0 without a stock gauge."""
    apple_ahead: Annotated[Bools, "B N U"]
    """U is 1 with `Rules.paint_over`, else 0."""
    waste: Annotated[NDArray[np.int64], "B P"]
    """P is 1, or 0 without a river."""
    cleaned: Annotated[Floats, "B M"]
    """M is N, or 0 without a river."""
    stock: Annotated[NDArray[np.int64], "B 1"]
    regrown: Annotated[NDArray[np.int64], "B 1"]
    terminated: Annotated[Bools, "B 1"]
    truncated: Annotated[Bools, "B 1"]
    done: Annotated[Bools, "B 1"]


class GovernedOutput(NamedTuple):
    """The output of a turn of a game with institutions."""

    turn: StepOutput
    payments: Payments


class Scratch(NamedTuple):
    """Working memory for one turn, one per thread: the rules allocate nothing."""

    start_row: Annotated[Ints, "N"]
    """The row in which each agent began the turn."""
    start_col: Annotated[Ints, "N"]
    """The column in which each agent began the turn."""
    order: Annotated[Ints, "N"]
    """A permutation of the agents: the order in which they move, or the rank of each; see `Rules.clashes`."""
    blocked: Annotated[Bools, "N"]
    """Whether the agent's move is being cancelled, or its return to play."""
    words: Annotated[NDArray[np.int64], "words"]
    """Random 32-bit words, K / 4 rounded up to a multiple of 4; one word serves four sites."""
    sprouts: Annotated[Ints, "K"]
    """The sites that grow an apple in this turn come first."""
    picture: Annotated[Ints, "cells"]
    """The board and a rim of wall around it, as paints (see `Tables.paints`)."""
    seen: Annotated[Ints, "window"]
    """The paints of the window being written, X * Y of them."""


class Shown(NamedTuple):
    """One world for display: copies, as numpy arrays. Entries without a docstring are those of `Worlds`."""

    observation: Bytes
    """uint8 [N, C, X, Y], what each agent observes."""
    board: Bytes
    """uint8 [H, W], classes of `cprl.commons.colours`."""
    stock: Bytes
    row: Ints
    col: Ints
    heading: Ints
    in_play: Bools
    harvested: Ints


def empty_worlds(game: "Game", worlds: int) -> Worlds:
    """Memory for B worlds, all zero except `episode`, which is -1; `Batch.begin` starts the first episode."""
    empty = filled(Worlds, {}, B=worlds, N=game.agents, K=len(game.map.sites), R=len(game.map.river))
    empty.episode[:] = -1
    return empty


CACHE_LINE_BYTES = 128
"""Padding after each array of a Scratch, in entries: threads that share a cache line slow each other down."""


def empty_scratch(game: "Game") -> Scratch:
    """The working memory of one thread."""
    sites, cells, window = len(game.map.sites), game.tables.background.size, game.tables.window_cells.shape[1]
    words = 4 * -(-sites // SITES_PER_DRAW)
    forms = forms_of(Scratch, N=game.agents, K=sites, words=words, cells=cells, window=window)
    arrays: list[Any] = [
        np.zeros(length + CACHE_LINE_BYTES, dtype)[:length] for (length,), dtype in forms.values()
    ]
    return Scratch(*arrays)
