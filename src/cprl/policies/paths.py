"""Shortest paths in one window: the cells an agent sees, their distance in steps, and the first step.

A window of X x Y cells is surrounded by a frame of wall and stored flat: a cell is an index, and adjacent
cells are `Frame.stride` or 1 apart. The agent is in the middle of the window's last row and faces up. The
cells behind it are not in the window, so no path leads there. `cprl.policies.scripted` compiles these plain
functions.
"""

from typing import NamedTuple

import numpy as np

from cprl.commons.world import Bools, Bytes, Ints

OPEN, APPLE, AGENT, UNKNOWN, WALL = range(5)
"""The roles of cells; paths can reach those up to AGENT. The agent's own cell is OPEN."""


class Frame(NamedTuple):
    """The layout of a framed window."""

    stride: int
    """The number of cells per row, frame included."""
    own: int
    """The index of the agent's cell."""
    cells: Ints
    """int32 [X * Y], the indices of the window's cells in reading order."""
    neighbours: Ints
    """int32 [4], the offsets to the cell ahead, on the left, on the right and behind."""
    near: Ints
    """int32 [n], the offsets to all cells that count as near; the frame is wide enough for them."""


class Scratch(NamedTuple):
    """Working memory, [cells] each: one entry for each cell of a framed window."""

    blocked: Bools
    """bool, the cells that no path passes through."""
    targets: Bools
    """bool, the cells to walk to."""
    steps: Ints
    """int32, the distance of each cell from the agent in steps; -1 if it cannot be reached."""
    others_steps: Ints
    """int32, the distance of each cell from the nearest other agent, likewise."""
    queue: Ints
    """int32, the cells that the search has reached, in the order of their distance."""


def spread(roles: Bytes, frame: Frame, blocked: Bools, steps: Ints, queue: Ints, known: int) -> None:
    """Breadth-first search from the first `known` cells of the queue; fills in `steps`.

    `steps` is 0 at these cells and -1 elsewhere. The search reaches blocked cells but does not pass them.
    """
    done = 0
    while done < known:
        cell = queue[done]
        done += 1
        if blocked[cell] and steps[cell] > 0:
            continue
        for offset in frame.neighbours:
            beside = np.uint64(cell + offset)
            if steps[beside] < 0 and roles[beside] <= AGENT:
                steps[beside] = steps[cell] + 1
                queue[known] = beside
                known += 1


def count_own_steps(roles: Bytes, frame: Frame, scratch: Scratch) -> None:
    """Computes the distance of each cell from the agent."""
    scratch.steps[:] = -1
    scratch.steps[frame.own] = 0
    scratch.queue[0] = frame.own
    spread(roles, frame, scratch.blocked, scratch.steps, scratch.queue, 1)


def count_others_steps(roles: Bytes, frame: Frame, scratch: Scratch) -> None:
    """Computes the distance of each cell from the nearest other agent."""
    known = 0
    scratch.others_steps[:] = -1
    for cell in frame.cells:
        if roles[cell] == AGENT:
            scratch.others_steps[cell] = 0
            scratch.queue[known] = cell
            known += 1
    spread(roles, frame, scratch.blocked, scratch.others_steps, scratch.queue, known)


def nearest(frame: Frame, scratch: Scratch) -> int:
    """The nearest target, the first of equally near ones in reading order; -1 if none can be reached."""
    best, fewest = -1, scratch.steps.size
    for cell in frame.cells:
        if scratch.targets[cell] and 0 <= scratch.steps[cell] < fewest:
            best, fewest = cell, scratch.steps[cell]
    return best


def step_to(frame: Frame, goal: int, scratch: Scratch) -> int:
    """The first cell on a shortest path to a reachable cell."""
    steps, cell = scratch.steps, goal
    while steps[cell] > 1:
        for offset in frame.neighbours:
            if steps[cell + offset] == steps[cell] - 1 and not scratch.blocked[cell + offset]:
                cell += offset
                break
    return cell


def is_beside_an_agent(roles: Bytes, frame: Frame, cell: int) -> bool:
    """Whether a visible other agent is adjacent to a cell."""
    agents = 0
    for offset in frame.neighbours:
        agents += roles[cell + offset] == AGENT
    return agents > 0


def apples_near(roles: Bytes, frame: Frame, cell: int) -> int:
    """The number of visible apples near a cell, without one on the cell itself."""
    count = 0
    for away in frame.near:
        count += roles[cell + away] == APPLE
    return count
