"""Where agents go: a trace of played episodes, whose cells agents share or keep, and who tags whom where.

Arrays of a played episode with T steps, B worlds and N agents, at the start of each step:
    row, col    int [T, B, N], the cell of each agent
    in_play     bool [T, B, N], whether the agent acts in this step
    fired       bool [T, B, N], whether the agent fires in this step
    played      bool [T, B], True until the world's episode has ended

Visits are shares [..., N, H, W], float64, as `visit_shares` returns them: for each agent the share of its
steps in play that it spent in each cell. They sum to 1, or to 0 for an agent that was never in play, which
then counts in none of the measures of visits. Shares of few steps look more exclusive than they are, since
agents that visit many cells seldom have hit the same ones by chance: average the visits of many episodes
first, and compare with other agents, such as random ones, over as many steps from the same starts.
"""

from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cprl import keys
from cprl.envs.commons_env import CommonsEnv
from cprl.measuring.playing import Policy, turns

_Array = NDArray[Any]


@dataclass(frozen=True, kw_only=True, eq=False)
class Trace:
    """One episode of every world; for its arrays see the module."""

    row: _Array
    col: _Array
    in_play: _Array
    fired: _Array
    played: _Array
    board: tuple[int, int]
    """The height H and width W of the board in cells."""
    tags: _Array = field(default_factory=lambda: np.zeros((0, 4), np.int64))
    """Every tag, int64 [K, 4] in order: its step and world, the agent that was tagged, and who tagged it."""

    def worlds(self, first: int, end: int) -> "Trace":
        """Return the trace of some of its worlds, from `first` on and without `end`."""
        tags = self.tags[(self.tags[:, 1] >= first) & (self.tags[:, 1] < end)]
        names = ("row", "col", "in_play", "fired", "played")
        arrays = {name: getattr(self, name)[:, first:end] for name in names}
        return Trace(**arrays, board=self.board, tags=tags - np.array([0, first, 0, 0]))


def trace(env: CommonsEnv, policy: Policy, *, explore: bool = True) -> Trace:
    """Play the next episode of each world, and record where all agents are."""
    now = env.worlds.now
    read = env.worlds.driver.read
    played = turns(env, policy, explore=explore)
    seen: dict[str, list[_Array]] = {name: [] for name in ("row", "col", "in_play", "fired", "played")}
    tags: list[_Array] = []
    row = read(now.row)
    col = read(now.col)
    is_going = np.ones(len(row), np.bool_)  # a world with transforms plays on once it has ended
    for step, batch in enumerate(played):
        seen["row"].append(row)
        seen["col"].append(col)
        seen["in_play"].append(batch[keys.IN_PLAY].numpy(force=True).copy())
        seen["fired"].append(batch["next"][keys.FIRED].numpy(force=True) & is_going[:, None])
        seen["played"].append(is_going)
        hits = np.argwhere(batch["next"][keys.TAGGED_BY].numpy(force=True) & is_going[:, None, None])
        tags.append(np.insert(hits, 0, step, axis=1))
        is_going = is_going & ~batch["next"][keys.DONE][:, 0].numpy(force=True)
        row = read(now.row)
        col = read(now.col)
    arrays = {name: np.stack(values) for name, values in seen.items()}
    return Trace(**arrays, board=(env.game.map.height, env.game.map.width), tags=np.concatenate(tags))


def visit_shares(trace: Trace) -> _Array:
    """Return the share of its steps in play that each agent spent in each cell, float64 [B, N, H, W]."""
    counts = np.zeros((*trace.row.shape[1:], *trace.board))
    at = np.nonzero(trace.in_play & trace.played[..., None])
    np.add.at(counts, (*at[1:], trace.row[at], trace.col[at]), 1)
    shares: _Array = counts / np.maximum(counts.sum((-2, -1), keepdims=True), 1)
    return shares


def overlap(trace: Trace) -> _Array:
    """Return the overlap of the cells that two agents visit, mean over all pairs, float64 [B], 0..1.

    The overlap of two agents is the sum over cells of the smaller of their two shares: 1 for equal visits, 0
    for disjoint ones. NaN for a single agent.
    """
    shares = visit_shares(trace)
    pairs = [
        np.minimum(shares[:, one], shares[:, other]).sum((-2, -1))
        for one, other in combinations(range(shares.shape[1]), 2)
    ]
    return np.mean(pairs, axis=0) if pairs else np.full(len(shares), np.nan)


def agents_per_cell(visits: ArrayLike) -> _Array:
    """Return how many agents share a cell, float64 [...], 1..N: 1 if each has cells of its own, N if all
    spend equal shares of their time in each cell.

    It is exp H(agent | cell): with p(i, c) = visits[i, c] / N, of the N agents that were in play, the entropy
    of who it is that one meets in a cell, mean over the cells by how often one meets somebody there. NaN
    without agents.
    """
    shares = np.asarray(visits, np.float64)
    agents = _in_play(shares)
    within = shares.sum(-3, keepdims=True)
    odds = np.divide(shares, within, out=np.zeros_like(shares), where=within > 0)
    logs = np.log(odds, out=np.zeros_like(odds), where=odds > 0)
    with np.errstate(invalid="ignore"):
        number: _Array = np.exp(-(shares * logs).sum((-3, -2, -1)) / agents)
    return np.where(agents > 0, number, np.nan)


def exclusion(visits: ArrayLike) -> _Array:
    """Return how far agents keep each other out of cells, float64 [...], 0..1: 1 if no cell has two visitors,
    0 if all agents spend equal shares of their time in each cell; NaN for fewer than two agents.

    It is 1 - H(agent | cell) / log N, or the information about who an agent is that its cell gives, as a
    share of all that there is; equal to the Jensen-Shannon divergence of the N distributions over cells,
    divided by log N (J. Lin, "Divergence measures based on the Shannon entropy", 1991).
    """
    agents = _in_play(visits)
    exclusions = np.full(agents.shape, np.nan)
    several = agents > 1
    exclusions[several] = 1 - np.log(agents_per_cell(visits)[several]) / np.log(agents[several])
    inside: _Array = np.clip(exclusions, 0, 1)
    return inside


def owners(visits: ArrayLike) -> _Array:
    """Return the agent that spends the largest share of its time in each cell, int64 [..., H, W]; of equal
    ones the first, and -1 where nobody was."""
    shares = np.asarray(visits, np.float64)
    agents: _Array = np.where(shares.any(-3), shares.argmax(-3), -1)
    return agents


def taggings(trace: Trace) -> _Array:
    """Return how often each agent was tagged by each, int64 [B, N, N]: row the tagged, column who tagged it.

    An agent that several beams hit at once is counted for each of those who fired.
    """
    _, worlds, agents = trace.row.shape
    counts = np.zeros((worlds, agents, agents), np.int64)
    np.add.at(counts, tuple(trace.tags[:, 1:].T), 1)
    return counts


def tagged_where(trace: Trace) -> _Array:
    """Return how often each agent was tagged in each cell, int64 [B, N, H, W].

    The cell is that at the start of the step, before the agent moved in it. An agent that several beams hit
    at once is counted once.
    """
    _, worlds, agents = trace.row.shape
    counts = np.zeros((worlds, agents, *trace.board), np.int64)
    step, world, tagged = np.unique(trace.tags[:, :3], axis=0).T
    cell = trace.row[step, world, tagged], trace.col[step, world, tagged]
    np.add.at(counts, (world, tagged, *cell), 1)
    return counts


def defence(trace: Trace, visits: ArrayLike) -> _Array:
    """Return the share of tags with which an agent drives another out of its own territory, float64 [B].

    A tag counts as 1 if the one who fired spends a larger share of its time in the cell of the tagged, as in
    `tagged_where`, than the tagged itself, 0 if a smaller one, and 1/2 if they are equal. NaN where no agent
    was tagged.

    Args:
        visits: shares [N, H, W], or [B, N, H, W].
    """
    worlds = trace.row.shape[1]
    shares = np.broadcast_to(np.asarray(visits), (worlds, trace.row.shape[2], *trace.board))
    step, world, tagged, by = trace.tags.T
    cell = trace.row[step, world, tagged], trace.col[step, world, tagged]
    more = np.sign(shares[world, by, *cell] - shares[world, tagged, *cell])
    sums = np.bincount(world, (1 + more) / 2, minlength=worlds)
    with np.errstate(invalid="ignore"):
        tags_at_home: _Array = sums / np.bincount(world, minlength=worlds)
    return tags_at_home


def _in_play(visits: ArrayLike) -> _Array:
    """Return how many agents were ever in play, int64 [...]."""
    return np.asarray(np.asarray(visits).any((-2, -1)).sum(-1))
