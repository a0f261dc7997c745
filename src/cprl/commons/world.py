"""What changes in an episode, B games at once, and what the rules hand out and borrow each turn.

The rules are written for ONE world: they get these same tuples with the axis B taken off.
"""

from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cprl.commons.chance import SITES_PER_DRAW

Ints: TypeAlias = NDArray[np.int32]
Bytes: TypeAlias = NDArray[np.uint8]
Bools: TypeAlias = NDArray[np.bool_]
Indices: TypeAlias = NDArray[np.uint32]
"""Unsigned, which spares Numba's test for negative indices."""
Actions: TypeAlias = NDArray[np.int64]
Words: TypeAlias = NDArray[np.uint64]

PLAYING, TERMINATED, TRUNCATED = 0, 1, 2
"""How a world stands: its episode goes on, no apple is left and none can come, the clock ran out."""

UP, RIGHT, DOWN, LEFT = 0, 1, 2, 3
"""Headings; one more is a quarter turn to the right."""

ROW_STEP = (-1, 0, 1, 0)
COL_STEP = (0, 1, 0, -1)
"""One cell ahead, by heading."""


class Worlds(NamedTuple):
    """The state of B worlds; int32 where nothing else is said."""

    seed: Words
    """uint64 [B, 1], what all chance of a world follows from, together with its number, episode and step."""
    number: Words
    """uint64 [B, 1], which world of that seed this is; below 2**32."""
    stock: Bytes
    """uint8 [B, K], 1 where an apple hangs."""
    stock_before: Bytes
    """uint8 [B, K], the stock as the turn began; kept only under `picture_shows_old_stock`."""
    near: Indices
    """uint32 [B, K], apples within reach of each site; follows from `stock`."""
    stock_left: Ints
    """[B, 1], the sum of `stock`."""
    row: Ints
    """[B, N], 0 at the upper edge."""
    col: Ints
    """[B, N], 0 at the left edge."""
    heading: Ints
    """[B, N], 0 up, 1 right, 2 down, 3 left."""
    out_steps: Ints
    """[B, N], turns still to miss."""
    in_play: Bools
    """[B, N], who acts in the coming turn."""
    on_board: Bools
    """[B, N], who was in play when the last picture was taken."""
    fired: Bools
    """[B, N], who fired in the last turn."""
    hits: Ints
    """[B, N], hits taken since the last tag."""
    tagged_step: Ints
    """[B, N], the step at which an agent was last tagged out, 0 for never."""
    offences: Ints
    """[B, N], how often an agent was tagged out in this episode."""
    harvested: Ints
    """[B, N], apples bitten in this episode."""
    step: Ints
    """[B, 1], turns played in this episode."""
    episode: Ints
    """[B, 1], episodes begun since the seed was set, less one."""
    ended: Ints
    """[B, 1], PLAYING, TERMINATED or TRUNCATED."""


class StepOutput(NamedTuple):
    """What a turn tells, written into arrays that the caller hands in (torch memory, as a rule)."""

    observation: Bytes
    """uint8 [B, N, C, X, Y]."""
    harvest: NDArray[np.float32]
    """float32 [B, N]."""
    in_play: Bools
    """bool [B, N], who acts in the coming turn."""
    fired: Bools
    """bool [B, N]."""
    hit_by: Bools
    """bool [B, N, N], row hit, column shooter."""
    tagged_by: Bools
    """bool [B, N, N], row tagged out, column shooter."""
    scoreboard: NDArray[np.float32]
    """float32 [B, N, N], a row per observer: apples that everybody has bitten in this episode, its own first,
    then of the next numbers, round and round; [B, N, 0] where no scoreboard is observed."""
    stock_gauge: NDArray[np.float32]
    """float32 [B, N, 1], the share of all sites that hold an apple; [B, N, 0] where it is not observed."""
    stock: NDArray[np.int64]
    """int64 [B, 1]."""
    regrown: NDArray[np.int64]
    """int64 [B, 1]."""
    terminated: Bools
    """bool [B, 1]."""
    truncated: Bools
    """bool [B, 1]."""
    done: Bools
    """bool [B, 1]."""


class Scratch(NamedTuple):
    """Paper to write on during a turn, a sheet for each thread: the rules allocate nothing."""

    start_row: Ints
    """[N], where each agent began the turn."""
    start_col: Ints
    """[N]."""
    blocked: Bools
    """[N], whose move is being cancelled."""
    words: NDArray[np.int64]
    """int64 [K / 4, rounded up to draws of 4], random words, four sites a word."""
    sprouts: Ints
    """[K], the sites that grow an apple this turn."""
    picture: Ints
    """[cells], the board and a rim of wall around it, as paints."""
    seen: Ints
    """[X * Y], the paints of the window being cut."""


class Shown(NamedTuple):
    """One world as people look at it: numpy arrays, copies."""

    observation: Bytes
    """uint8 [N, C, X, Y], what each agent observes."""
    board: Bytes
    """uint8 [H, W], classes of `cprl.commons.colours`."""
    stock: Bytes
    """uint8 [K], 1 where an apple hangs."""
    row: Ints
    """int32 [N]."""
    col: Ints
    """int32 [N]."""
    heading: Ints
    """int32 [N], 0 up, 1 right, 2 down, 3 left."""
    in_play: Bools
    """bool [N]."""
    harvested: Ints
    """int32 [N], apples bitten in this episode."""


def empty_worlds(*, worlds: int, agents: int, sites: int) -> Worlds:
    """Room for B worlds, all zero; `begin` makes an episode of it."""

    def ints(*shape: int) -> Ints:
        return np.zeros((worlds, *shape), np.int32)

    def bools(*shape: int) -> Bools:
        return np.zeros((worlds, *shape), np.bool_)

    def bytes_(*shape: int) -> Bytes:
        return np.zeros((worlds, *shape), np.uint8)

    return Worlds(
        seed=np.zeros((worlds, 1), np.uint64),
        number=np.zeros((worlds, 1), np.uint64),
        stock=bytes_(sites),
        stock_before=bytes_(sites),
        near=np.zeros((worlds, sites), np.uint32),
        stock_left=ints(1),
        row=ints(agents),
        col=ints(agents),
        heading=ints(agents),
        out_steps=ints(agents),
        in_play=bools(agents),
        on_board=bools(agents),
        fired=bools(agents),
        hits=ints(agents),
        tagged_step=ints(agents),
        offences=ints(agents),
        harvested=ints(agents),
        step=ints(1),
        episode=np.full((worlds, 1), -1, np.int32),
        ended=ints(1),
    )


CACHE_LINE_BYTES = 128
"""Room behind each array of a sheet: threads that write into one line of the cache hinder each other."""


def empty_scratch(*, agents: int, sites: int, cells: int, window: int) -> Scratch:
    """A sheet for one thread."""

    def room(length: int, dtype: type[np.generic] = np.int32) -> NDArray[Any]:
        return np.zeros(length + CACHE_LINE_BYTES, dtype)[:length]

    return Scratch(
        start_row=room(agents),
        start_col=room(agents),
        blocked=room(agents, np.bool_),
        words=room(4 * -(-sites // SITES_PER_DRAW), np.int64),
        sprouts=room(sites),
        picture=room(cells),
        seen=room(window),
    )
