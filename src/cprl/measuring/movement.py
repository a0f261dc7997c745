"""Where agents go and when they fire: measures for the study's claims about trained policies.

Arrays of a played episode with T steps, B worlds and N agents, at the start of each step:
    row, col    int [T, B, N], the cell of each agent
    in_play     bool [T, B, N], whether the agent acts in this step
    fired       bool [T, B, N], whether the agent fires in this step
    played      bool [T, B], True until the world's episode has ended
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from cprl import keys
from cprl.envs.commons_env import CommonsEnv
from cprl.system.process import one_thread

Array = NDArray[Any]


@dataclass(frozen=True, kw_only=True, eq=False)
class Trace:
    """One episode of every world; for its arrays see the module."""

    row: Array
    col: Array
    in_play: Array
    fired: Array
    played: Array
    board: tuple[int, int]
    """The height H and width W of the board in cells."""
    tags: Array = field(default_factory=lambda: np.zeros((0, 4), np.int64))
    """Every tag, int64 [K, 4] in order: its step and world, the agent that was tagged, and who tagged it."""


def trace(
    env: CommonsEnv, policy: Callable[[TensorDictBase], TensorDictBase], *, explore: bool = True
) -> Trace:
    """Plays the next episode of each world and records the positions of all agents.

    Args:
        env: B worlds; all are reset.
        policy: Writes the actions of all agents.
        explore: Whether actors explore with their epsilon.
    """
    steps: list[tuple[Array, ...]] = []
    tags: list[Array] = []
    exploration = ExplorationType.RANDOM if explore else ExplorationType.DETERMINISTIC
    now, read = env.worlds.now, env.worlds.driver.read
    with torch.no_grad(), one_thread(), set_exploration_type(exploration):
        moment = env.reset()
        while not moment["done"].all():
            places = read(now.row), read(now.col)
            before = moment[keys.IN_PLAY].numpy(force=True), ~moment["done"][:, 0].numpy(force=True)
            played = env.step(policy(moment))
            moment = played["next"].exclude(keys.REWARD)
            states = played.get(keys.RECURRENT_STATE, None)
            if states is not None:
                moment[keys.RECURRENT_STATE] = states
            hits = np.argwhere(moment[keys.TAGGED_BY].numpy(force=True))
            tags.append(np.insert(hits, 0, len(steps), axis=1))
            steps.append((*places, *before, moment[keys.FIRED].numpy(force=True)))
    row, col, in_play, played, fired = (np.stack(entries) for entries in zip(*steps, strict=True))
    board = env.game.map.height, env.game.map.width
    return Trace(
        row=row,
        col=col,
        in_play=in_play,
        fired=fired,
        played=played,
        board=board,
        tags=np.concatenate(tags),
    )


def visits(trace: Trace) -> Array:
    """The share of its steps in play that each agent spent in each cell, float64 [B, N, H, W]."""
    steps, worlds, agents = trace.row.shape
    counts = np.zeros((worlds, agents, *trace.board))
    here = trace.in_play & trace.played[..., None]
    world, agent = np.broadcast_arrays(np.arange(worlds)[:, None], np.arange(agents))
    for step in range(steps):
        at = here[step]
        place = world[at], agent[at], trace.row[step][at], trace.col[step][at]
        counts[place] += 1  # an agent is in one cell at a time
    shares: Array = counts / np.maximum(counts.sum((-2, -1), keepdims=True), 1)
    return shares


def overlap(trace: Trace) -> Array:
    """The overlap of the cells that two agents visit, mean over all pairs, float64 [B], 0..1.

    The overlap of two agents is the sum over cells of the smaller of their two shares: 1 for equal visits, 0
    for disjoint ones. NaN for a single agent.
    """
    shares = visits(trace)
    agents = shares.shape[1]
    pairs = [
        np.minimum(shares[:, a], shares[:, b]).sum((-2, -1))
        for a in range(agents)
        for b in range(a + 1, agents)
    ]
    return np.mean(pairs, axis=0) if pairs else np.full(len(shares), np.nan)
