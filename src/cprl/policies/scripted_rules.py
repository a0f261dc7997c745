"""The scripted policies: an agent's action, given its window; `cprl.policies.scripted` describes them.

A window of X x Y cells is surrounded by a frame of wall and stored flat: a cell is an index, and adjacent
cells are `Frame.stride` or 1 apart. The agent is in the middle of the window's last row and faces up. The
cells behind it are not in the window, so no path leads there. First come shortest paths: the cells an agent
sees, their distance in steps, and the first step; then what it does. `cprl.policies.scripted` compiles these
plain functions.
"""

from typing import Final, NamedTuple

import numpy as np

from cprl.commons.cells import FIRST_AGENT
from cprl.values.array_types import Bool, Float64, Int32, Int64, UInt8

OPEN, APPLE, AGENT, FOE, UNKNOWN, WALL = range(6)
"""The roles of cells; paths can reach those up to FOE, another agent at whom this one fires. The agent's own
cell is OPEN."""


class Frame(NamedTuple):
    """The layout of a framed window."""

    stride: int
    """The number of cells per row, frame included."""
    middle: int
    """The index of the agent's cell."""
    cells: Int32
    """int32 [X * Y], the indices of the window's cells in reading order."""
    neighbours: Int32
    """int32 [4], the offsets to the cell ahead, on the left, on the right and behind."""
    near: Int32
    """int32 [n], the offsets to all cells that count as near; the frame is wide enough for them."""


class SearchBuffers(NamedTuple):
    """The working memory of a search, [cells] each: one entry for each cell of a framed window."""

    blocked: Bool
    """bool, the cells that no path passes through."""
    targets: Bool
    """bool, the cells to walk to."""
    steps: Int32
    """int32, the distance of each cell from the agent in steps; -1 if it cannot be reached."""
    others_steps: Int32
    """int32, the distance of each cell from the nearest other agent; -1 if none can reach it."""
    queue: Int32
    """int32, the cells that the search has reached, in the order of their distance."""


def spread(roles: UInt8, frame: Frame, blocked: Bool, steps: Int32, queue: Int32, known: int) -> None:
    """Search breadth-first from the first `known` cells of the queue; fill in `steps`.

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
            if steps[beside] < 0 and roles[beside] <= FOE:
                steps[beside] = steps[cell] + 1
                queue[known] = beside
                known += 1


def is_agent(role: int) -> bool:
    """Return whether a role is that of another agent."""
    return role in (AGENT, FOE)


def count_own_steps(roles: UInt8, frame: Frame, scratch: SearchBuffers) -> None:
    """Compute the distance of each cell from the agent."""
    scratch.steps[:] = -1
    scratch.steps[frame.middle] = 0
    scratch.queue[0] = frame.middle
    spread(roles, frame, scratch.blocked, scratch.steps, scratch.queue, 1)


def count_others_steps(roles: UInt8, frame: Frame, scratch: SearchBuffers) -> None:
    """Compute the distance of each cell from the nearest other agent."""
    known = 0
    scratch.others_steps[:] = -1
    for cell in frame.cells:
        if is_agent(roles[cell]):
            scratch.others_steps[cell] = 0
            scratch.queue[known] = cell
            known += 1
    spread(roles, frame, scratch.blocked, scratch.others_steps, scratch.queue, known)


def nearest(frame: Frame, scratch: SearchBuffers) -> int:
    """Return the nearest target, the first of equally near ones in reading order; -1 if none is reachable."""
    best = -1
    fewest = scratch.steps.size
    for cell in frame.cells:
        if scratch.targets[cell] and 0 <= scratch.steps[cell] < fewest:
            best = cell
            fewest = scratch.steps[cell]
    return best


def step_to(frame: Frame, goal: int, scratch: SearchBuffers) -> int:
    """Return the first cell on a shortest path to a reachable cell."""
    steps = scratch.steps
    cell = goal
    while steps[cell] > 1:
        for offset in frame.neighbours:
            if steps[cell + offset] == steps[cell] - 1 and not scratch.blocked[cell + offset]:
                cell += offset
                break
    return cell


def is_beside_an_agent(roles: UInt8, frame: Frame, cell: int) -> bool:
    """Return whether a visible other agent is adjacent to a cell."""
    agents = 0
    for offset in frame.neighbours:
        agents += is_agent(roles[cell + offset])
    return agents > 0


def apples_near(roles: UInt8, frame: Frame, cell: int) -> int:
    """Count the visible apples near a cell, without one on the cell itself."""
    count = 0
    for away in frame.near:
        count += roles[cell + away] == APPLE
    return count


RANDOM, GREEDY, SUSTAINABLE, TERRITORIAL, AGGRESSIVE, PACIFIST = range(6)

FORWARD, BACKWARD, LEFT, RIGHT, TURN_LEFT, TURN_RIGHT, BEAM = range(7)
"""Indices into `cprl.commons.rules.ACTIONS`; for "stay" see `Settings`."""

EXPLORES, WHICH, WANDERS, WAITS, NUMBERS = range(5)
"""The uses of an agent's random numbers in a turn, and their count NUMBERS."""

WALK_ON_PROB: Final = 0.9
"""The probability that a wandering agent walks forward if the cell ahead is free."""
WAIT_PROB: Final = 0.5
"""The probability that an agent waits where another agent may want the same cell: if both go, neither gets
it (docs/game.md)."""


class Settings(NamedTuple):
    """The properties of the game that an agent's choice depends on, besides its window."""

    actions: int
    """The number of actions without a signal: these agents are silent."""
    stay: int
    """The index of the action "stay"."""
    may_fire: bool
    beam_length: int
    """The cells ahead that a beam covers for every heading, since an agent does not know its heading."""
    beam_half_width: int
    """The cells to each side that a beam covers; at most those in the window."""
    beam_tapers: bool
    beam_from_beside: bool
    beam_stops_at_agents: bool


POLICY, SPARED, REGION_ROWS, REGION_COLUMNS, FOES = range(5)
"""The indices of the numbers of `cprl.policies.scripted.Plan`; those from FOES on are of agents."""


def mark_foes(roles: UInt8, classes: UInt8, foes: Int64) -> None:
    """Make the agents at whom this one fires FOE; those that look alike are if it fires at all."""
    fires_at_all = foes.all()
    for cell in range(roles.size):
        if roles[cell] == AGENT:
            agent = int(classes[cell]) - FIRST_AGENT
            if fires_at_all or (agent >= 0 and foes[agent]):
                roles[cell] = FOE


def is_in_region(frame: Frame, plan: Int64, cell: int) -> bool:
    """Return whether the agent harvests at a cell."""
    ahead = frame.middle // frame.stride - cell // frame.stride
    side = abs(cell % frame.stride - frame.middle % frame.stride)
    return bool(ahead <= plan[REGION_ROWS] and side <= plan[REGION_COLUMNS])


def target_apples(roles: UInt8, frame: Frame, plan: Int64, scratch: SearchBuffers) -> None:
    """Make the apples of the agent's region targets; block all other apples, and other agents."""
    for cell in frame.cells:
        scratch.targets[cell] = roles[cell] == APPLE
        scratch.blocked[cell] = is_agent(roles[cell])
        if scratch.targets[cell] and not is_in_region(frame, plan, cell):
            exclude_apple(scratch, cell)


def exclude_apple(scratch: SearchBuffers, cell: int) -> None:
    """Make an apple no target and block its cell."""
    scratch.targets[cell] = False
    scratch.blocked[cell] = True


def exclude_sparse_apples(roles: UInt8, frame: Frame, spared: int, scratch: SearchBuffers) -> None:
    """Exclude the targets with fewer than `spared` other apples near them."""
    for cell in frame.cells:
        if scratch.targets[cell] and apples_near(roles, frame, cell) < spared:
            exclude_apple(scratch, cell)


def exclude_apples_nearer_to_others(roles: UInt8, frame: Frame, scratch: SearchBuffers) -> None:
    """Exclude the targets that another agent reaches in fewer steps."""
    count_own_steps(roles, frame, scratch)
    count_others_steps(roles, frame, scratch)
    for cell in frame.cells:
        if scratch.targets[cell] and 0 <= scratch.others_steps[cell] < scratch.steps[cell]:
            exclude_apple(scratch, cell)


def walk_to(
    roles: UInt8, frame: Frame, goal: int, number: float, settings: Settings, scratch: SearchBuffers
) -> int:
    """Return the action for the first step on a shortest path to a reachable cell; it may wait for another
    agent."""
    cell = step_to(frame, goal, scratch)
    if is_beside_an_agent(roles, frame, cell) and number < WAIT_PROB:
        return settings.stay
    if cell == frame.middle - 1:
        return LEFT
    return RIGHT if cell == frame.middle + 1 else FORWARD


def wander(roles: UInt8, frame: Frame, number: float, scratch: SearchBuffers) -> int:
    """Walk forward with WALK_ON_PROB if the cell ahead is free; otherwise turn left or right."""
    ahead = frame.middle - frame.stride
    if roles[ahead] <= APPLE and not scratch.blocked[ahead]:
        if number < WALK_ON_PROB:
            return FORWARD
        number = (number - WALK_ON_PROB) / (1 - WALK_ON_PROB)
    return TURN_LEFT if number < 0.5 else TURN_RIGHT


def has_target(roles: UInt8, frame: Frame, settings: Settings, guards: bool) -> bool:
    """Return whether a beam would cover a visible foe; with `guards`, one that is near a visible apple."""
    for side in range(-settings.beam_half_width, settings.beam_half_width + 1):
        begin = 0 if settings.beam_from_beside and side != 0 else 1
        end = settings.beam_length - abs(side) if settings.beam_tapers else settings.beam_length
        for ahead in range(begin, end + 1):
            cell = frame.middle + side - ahead * frame.stride
            if roles[cell] == WALL:
                break
            if is_agent(roles[cell]):
                if roles[cell] == FOE and (not guards or apples_near(roles, frame, cell) > 0):
                    return True
                if settings.beam_stops_at_agents:
                    break
    return False


def pursue(roles: UInt8, frame: Frame, number: float, settings: Settings, scratch: SearchBuffers) -> int:
    """Turn towards the nearest reachable foe or walk towards it; -1 if there is none."""
    for cell in frame.cells:
        scratch.targets[cell] = roles[cell] == FOE
    goal = nearest(frame, scratch)
    if goal < 0:
        return -1
    ahead = frame.middle // frame.stride - goal // frame.stride
    side = goal % frame.stride - frame.middle % frame.stride
    if abs(side) > ahead:
        return TURN_RIGHT if side > 0 else TURN_LEFT
    return walk_to(roles, frame, goal, number, settings, scratch)


def choose(
    policy: int,
    plan: Int64,
    roles: UInt8,
    frame: Frame,
    numbers: Float64,
    settings: Settings,
    scratch: SearchBuffers,
) -> int:
    """Choose the action of one agent.

    Args:
        policy: the policy by which it chooses in this turn.
        plan: int64 [4 + N], the numbers of its plan.
        roles: uint8 [cells], the roles of the cells of its framed window.
        numbers: float64 [NUMBERS], uniform random numbers in [0, 1).
    """
    if policy == RANDOM:
        return int(numbers[WHICH] * settings.actions)
    fires = settings.may_fire and plan[FOES:].any()
    if fires and has_target(roles, frame, settings, policy == TERRITORIAL):
        return BEAM
    target_apples(roles, frame, plan, scratch)
    if policy == SUSTAINABLE:
        exclude_sparse_apples(roles, frame, plan[SPARED], scratch)
    elif policy == PACIFIST:
        exclude_apples_nearer_to_others(roles, frame, scratch)
    count_own_steps(roles, frame, scratch)
    if policy == AGGRESSIVE:
        action = pursue(roles, frame, numbers[WAITS], settings, scratch)
        if action >= 0:
            return action
        target_apples(roles, frame, plan, scratch)
    goal = nearest(frame, scratch)
    if goal < 0:
        return wander(roles, frame, numbers[WANDERS], scratch)
    return walk_to(roles, frame, goal, numbers[WAITS], settings, scratch)


def choose_all(
    plans: Int64,
    epsilon: float,
    classes: UInt8,
    roles: UInt8,
    frame: Frame,
    numbers: Float64,
    settings: Settings,
    scratch: SearchBuffers,
    chosen: Int64,
) -> None:
    """Choose the actions of n agents; each is random with probability `epsilon`.

    Args:
        plans: int64 [n, 4 + N], the numbers of the plan of each agent.
        classes: uint8 [n, cells], the classes of the cells of each framed window.
        roles: uint8 [n, cells], their roles, of agents AGENT; those at whom an agent fires become FOE.
        numbers: float64 [n, NUMBERS], uniform random numbers in [0, 1).
        chosen: int64 [n], receives the actions.
    """
    for n in range(roles.shape[0]):
        policy = RANDOM if numbers[n, EXPLORES] < epsilon else plans[n, POLICY]
        mark_foes(roles[n], classes[n], plans[n, FOES:])
        chosen[n] = choose(policy, plans[n], roles[n], frame, numbers[n], settings, scratch)
