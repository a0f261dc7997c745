"""Ways through ONE window: what is seen where, how far it is, and the first step there.

A window X x Y lies in a frame of wall, flat: a cell is one number, and the cells beside it are
`Frame.stride` and 1 away. The agent itself stands in the middle of the window's last row and looks up. What
lies behind it is not in the window, so no way leads there. Plain functions, which
`cprl.policies.scripted` compiles.
"""

from typing import Any, Final, NamedTuple

import numpy as np

from cprl.commons.world import Bools, Bytes, Ints

OPEN, APPLE, AGENT, UNKNOWN, WALL = range(5)
"""Roles of a cell; those up to AGENT can be walked up to. The agent's own cell is OPEN."""


class Frame(NamedTuple):
    """Where the cells of a framed window are."""

    stride: int
    """Cells from one row to the next."""
    own: int
    """The agent's cell."""
    cells: Ints
    """int32 [X * Y], the window's cells in reading order."""
    ways: Ints
    """int32 [4]: to the cell ahead, to the left, to the right, behind."""
    near: Ints
    """int32 [n]: to each cell that counts as near; the frame is wide enough for all."""


class Scratch(NamedTuple):
    """Borrowed memory, an entry for each cell of a framed window."""

    shut: Bools
    """Cells that are not walked through."""
    wanted: Bools
    """Cells that are walked to."""
    steps: Ints
    """How many steps away a cell is, -1 where it cannot be reached."""
    others_steps: Ints
    """The same from the nearest other agent."""
    queue: Ints


def spread(roles: Bytes, frame: Frame, shut: Bools, steps: Ints, queue: Ints, known: int) -> None:
    """Fills in `steps` from the first `known` cells of the queue, at which it is 0; elsewhere it is -1.

    A cell that is shut is reached, but nobody goes on from there.
    """
    done = 0
    while done < known:
        cell = queue[done]
        done += 1
        if shut[cell] and steps[cell] > 0:
            continue
        for way in frame.ways:
            beside = np.uint64(cell + way)
            if steps[beside] < 0 and roles[beside] <= AGENT:
                steps[beside] = steps[cell] + 1
                queue[known] = beside
                known += 1


def count_own_steps(roles: Bytes, frame: Frame, scratch: Scratch) -> None:
    """How far each cell is for the agent itself."""
    scratch.steps[:] = -1
    scratch.steps[frame.own] = 0
    scratch.queue[0] = frame.own
    spread(roles, frame, scratch.shut, scratch.steps, scratch.queue, 1)


def count_others_steps(roles: Bytes, frame: Frame, scratch: Scratch) -> None:
    """How far each cell is for the other agent that is nearest to it."""
    known = 0
    scratch.others_steps[:] = -1
    for cell in frame.cells:
        if roles[cell] == AGENT:
            scratch.others_steps[cell] = 0
            scratch.queue[known] = cell
            known += 1
    spread(roles, frame, scratch.shut, scratch.others_steps, scratch.queue, known)


def nearest(frame: Frame, scratch: Scratch) -> int:
    """The wanted cell with the fewest steps, the first in reading order; -1 for none in reach."""
    best, fewest = -1, scratch.steps.size
    for cell in frame.cells:
        if scratch.wanted[cell] and 0 <= scratch.steps[cell] < fewest:
            best, fewest = cell, scratch.steps[cell]
    return best


def step_to(frame: Frame, goal: int, scratch: Scratch) -> int:
    """The first cell of a shortest way to a cell that can be reached."""
    steps, cell = scratch.steps, goal
    while steps[cell] > 1:
        for way in frame.ways:
            if steps[cell + way] == steps[cell] - 1 and not scratch.shut[cell + way]:
                cell += way
                break
    return cell


def is_beside_an_agent(roles: Bytes, frame: Frame, cell: int) -> bool:
    """Whether another agent is seen right beside a cell."""
    agents = 0
    for way in frame.ways:
        agents += roles[cell + way] == AGENT
    return agents > 0


def apples_near(roles: Bytes, frame: Frame, cell: int) -> int:
    """How many apples are seen near a cell, not counting one on it."""
    count = 0
    for away in frame.near:
        count += roles[cell + away] == APPLE
    return count


FUNCTIONS: Final[tuple[Any, ...]] = (
    spread,
    count_own_steps,
    count_others_steps,
    nearest,
    step_to,
    is_beside_an_agent,
    apples_near,
)
"""In the order in which they call each other."""
