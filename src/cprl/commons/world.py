"""The arrays of B worlds: their state, the output of a step, and scratch memory.

The rules are written for one world: they receive these tuples without the axis B.
"""

from typing import Any, NamedTuple, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from cprl.commons.chance import SITES_PER_DRAW
from cprl.institutions.memory import Memory, Payments

Ints: TypeAlias = NDArray[np.int32]
Bytes: TypeAlias = NDArray[np.uint8]
Bools: TypeAlias = NDArray[np.bool_]
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
    """The state of B worlds; arrays are int32 unless stated otherwise."""

    seed: Words
    """uint64 [B, 1]. All random numbers of a world follow from its seed, number, episode and step."""
    number: Words
    """uint64 [B, 1], the index of this world among all worlds of its seed; below 2**32."""
    stock: Bytes
    """uint8 [B, K], 1 where a site holds an apple."""
    stock_before: Bytes
    """uint8 [B, K], the stock at the start of the turn; updated only under `picture_shows_old_stock`."""
    near: Indices
    """uint32 [B, K], the number of apples near each site; derived from `stock`."""
    stock_left: Ints
    """[B, 1], the sum of `stock`; derived from it."""
    row: Ints
    """[B, N], 0 is the top row."""
    col: Ints
    """[B, N], 0 is the leftmost column."""
    heading: Ints
    """[B, N], 0 up, 1 right, 2 down, 3 left."""
    out_steps: Ints
    """[B, N], the number of turns that the agent still has to miss."""
    in_play: Bools
    """bool [B, N], whether the agent acts in the coming turn."""
    on_board: Bools
    """bool [B, N], whether the agent was in play at the end of the last turn, before anyone returned."""
    fired: Bools
    """bool [B, N], whether the agent fired in the last turn."""
    moved_after_firing: Bools
    """bool [B, N], whether another agent then moved it by one cell to its right, so that its beam begins one
    cell to its left; only under `agent_1_right_moves_agent_0`, else all false."""
    hits: Ints
    """[B, N], hits since the last tag."""
    tagged_step: Ints
    """[B, N], the step at which the agent was last tagged; 0 for never."""
    offences: Ints
    """[B, N], how often the agent was tagged in this episode."""
    harvested: Ints
    """[B, N], apples harvested in this episode."""
    step: Ints
    """[B, 1], turns played in this episode."""
    episode: Ints
    """[B, 1], the index of the episode since the seed was set; -1 before the first."""
    ended: Ints
    """[B, 1], PLAYING, TERMINATED or TRUNCATED."""


class StepOutput(NamedTuple):
    """The output of a turn, written into arrays that the caller provides (usually torch memory)."""

    observation: Bytes
    """uint8 [B, N, C, X, Y]."""
    harvest: NDArray[np.float32]
    """float32 [B, N], apples harvested in this turn."""
    in_play: Bools
    """bool [B, N], whether the agent acts in the coming turn."""
    fired: Bools
    """bool [B, N], whether the agent fired in this turn."""
    hit_by: Bools
    """bool [B, N, N]; row: the agent hit, column: the shooter."""
    tagged_by: Bools
    """bool [B, N, N]; row: the agent tagged, column: the shooter."""
    scoreboard: NDArray[np.float32]
    """float32 [B, N, N], one row per observer: the harvest of every agent in this episode, the observer's own
    first, then of the following agent indices, cyclically; [B, N, 0] without a scoreboard."""
    stock_gauge: NDArray[np.float32]
    """float32 [B, N, 1], the share of all sites that hold an apple; [B, N, 0] without a stock gauge."""
    stock: NDArray[np.int64]
    """int64 [B, 1], apples on the board."""
    regrown: NDArray[np.int64]
    """int64 [B, 1], apples that grew in this turn."""
    terminated: Bools
    """bool [B, 1], no apple is left and none can grow."""
    truncated: Bools
    """bool [B, 1], the episode ran out of time."""
    done: Bools
    """bool [B, 1], terminated or truncated."""


class GovernedOutput(NamedTuple):
    """The output of a turn of a game with institutions."""

    turn: StepOutput
    payments: Payments


def arrays_of(output: StepOutput | GovernedOutput) -> dict[str, NDArray[Any]]:
    """All arrays of an output by name."""
    if isinstance(output, StepOutput):
        return output._asdict()
    return output.turn._asdict() | output.payments._asdict()


Arrays = TypeVar("Arrays", "Worlds", Memory)


class Governed(NamedTuple):
    """The state of B worlds with institutions, and what their agents decide."""

    worlds: Worlds
    memory: Memory
    decisions: Actions
    """int64 [B, N], read in the first turn of an episode."""


class Scratch(NamedTuple):
    """Working memory for one turn, one per thread: the rules allocate nothing.

    Arrays are int32 unless stated otherwise.
    """

    start_row: Ints
    """[N], the row in which each agent began the turn."""
    start_col: Ints
    """[N], the column in which each agent began the turn."""
    blocked: Bools
    """bool [N], whether the agent's move is being cancelled, or its return to play."""
    words: NDArray[np.int64]
    """int64 [K / 4, rounded up to a multiple of 4], random 32-bit words; one word serves four sites."""
    sprouts: Ints
    """[K], the sites that grow an apple in this turn come first."""
    picture: Ints
    """[cells], the board and a rim of wall around it, as paints (see `Tables.paints`)."""
    seen: Ints
    """[X * Y], the paints of the window being written."""


class Shown(NamedTuple):
    """One world for display: copies, as numpy arrays."""

    observation: Bytes
    """uint8 [N, C, X, Y], what each agent observes."""
    board: Bytes
    """uint8 [H, W], classes of `cprl.commons.colours`."""
    stock: Bytes
    """uint8 [K], 1 where a site holds an apple."""
    row: Ints
    """int32 [N]."""
    col: Ints
    """int32 [N]."""
    heading: Ints
    """int32 [N], 0 up, 1 right, 2 down, 3 left."""
    in_play: Bools
    """bool [N]."""
    harvested: Ints
    """int32 [N], apples harvested in this episode."""


def empty_worlds(*, worlds: int, agents: int, sites: int) -> Worlds:
    """Memory for B worlds, all zero except `episode`, which is -1; `Batch.begin` starts the first episode."""

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
        moved_after_firing=bools(agents),
        hits=ints(agents),
        tagged_step=ints(agents),
        offences=ints(agents),
        harvested=ints(agents),
        step=ints(1),
        episode=np.full((worlds, 1), -1, np.int32),
        ended=ints(1),
    )


CACHE_LINE_BYTES = 128
"""Padding after each array of a Scratch, in entries: threads that share a cache line slow each other down."""


def empty_scratch(*, agents: int, sites: int, cells: int, window: int) -> Scratch:
    """The working memory of one thread; `window`: cells X * Y of a window."""

    def padded(length: int, dtype: type[np.generic] = np.int32) -> NDArray[Any]:
        return np.zeros(length + CACHE_LINE_BYTES, dtype)[:length]

    return Scratch(
        start_row=padded(agents),
        start_col=padded(agents),
        blocked=padded(agents, np.bool_),
        words=padded(4 * -(-sites // SITES_PER_DRAW), np.int64),
        sprouts=padded(sites),
        picture=padded(cells),
        seen=padded(window),
    )
