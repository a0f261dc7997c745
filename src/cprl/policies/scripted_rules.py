"""The scripted policies: an agent's action, given its window; `cprl.policies.scripted` describes them.

Plain functions that `cprl.policies.scripted` compiles; cells and framed windows are those of
`cprl.policies.paths`.
"""

from typing import Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cprl.commons.world import Actions, Bytes
from cprl.policies.paths import (
    AGENT,
    APPLE,
    WALL,
    Frame,
    Scratch,
    apples_near,
    count_others_steps,
    count_own_steps,
    is_beside_an_agent,
    nearest,
    step_to,
)

RANDOM, GREEDY, SUSTAINABLE, TERRITORIAL, AGGRESSIVE, PACIFIST = range(6)

FORWARD, BACKWARD, LEFT, RIGHT, TURN_LEFT, TURN_RIGHT, BEAM = range(7)
"""Indices into `cprl.commons.rules.ACTIONS`; the last action of a game is "stay"."""

EXPLORES, WHICH, WANDERS, WAITS, NUMBERS = range(5)
"""The uses of an agent's random numbers in a turn, and their count NUMBERS."""

WALK_ON_PROB: Final = 0.9
"""The probability that a wandering agent walks forward if the cell ahead is free."""
WAIT_PROB: Final = 0.5
"""The probability that an agent waits where another agent may want the same cell: if both go, neither gets
it (docs/game.md)."""

Numbers: TypeAlias = NDArray[np.float64]


class Settings(NamedTuple):
    """The properties of the game that an agent's choice depends on, besides its window."""

    actions: int
    """The number of actions."""
    has_beam: bool
    """Whether there is a beam action."""
    beam_length: int
    """The cells ahead that a beam covers for every heading, since an agent does not know its heading; at most
    those in the window."""
    beam_half_width: int
    """The cells to each side that a beam covers; at most those in the window."""
    spare: int
    """The number of other apples near an apple that "sustainable" harvests."""


def target_apples(roles: Bytes, frame: Frame, scratch: Scratch) -> None:
    """Makes all apples targets and blocks the cells of other agents."""
    for cell in frame.cells:
        scratch.targets[cell] = roles[cell] == APPLE
        scratch.blocked[cell] = roles[cell] == AGENT


def exclude_apple(scratch: Scratch, cell: int) -> None:
    """Makes an apple no target and blocks its cell."""
    scratch.targets[cell] = False
    scratch.blocked[cell] = True


def exclude_sparse_apples(roles: Bytes, frame: Frame, settings: Settings, scratch: Scratch) -> None:
    """Excludes the targets with fewer than `spare` other apples near them."""
    for cell in frame.cells:
        if scratch.targets[cell] and apples_near(roles, frame, cell) < settings.spare:
            exclude_apple(scratch, cell)


def exclude_apples_nearer_to_others(roles: Bytes, frame: Frame, scratch: Scratch) -> None:
    """Excludes the targets that another agent reaches in fewer steps."""
    count_own_steps(roles, frame, scratch)
    count_others_steps(roles, frame, scratch)
    for cell in frame.cells:
        if scratch.targets[cell] and 0 <= scratch.others_steps[cell] < scratch.steps[cell]:
            exclude_apple(scratch, cell)


def walk_to(
    roles: Bytes, frame: Frame, goal: int, number: float, settings: Settings, scratch: Scratch
) -> int:
    """The action for the first step on a shortest path to a reachable cell; may wait for another agent."""
    cell = step_to(frame, goal, scratch)
    if is_beside_an_agent(roles, frame, cell) and number < WAIT_PROB:
        return settings.actions - 1
    if cell == frame.own - 1:
        return LEFT
    return RIGHT if cell == frame.own + 1 else FORWARD


def wander(roles: Bytes, frame: Frame, number: float, scratch: Scratch) -> int:
    """Walks forward with WALK_ON_PROB if the cell ahead is free; otherwise turns left or right."""
    ahead = frame.own - frame.stride
    if roles[ahead] <= APPLE and not scratch.blocked[ahead]:
        if number < WALK_ON_PROB:
            return FORWARD
        number = (number - WALK_ON_PROB) / (1 - WALK_ON_PROB)
    return TURN_LEFT if number < 0.5 else TURN_RIGHT


def has_target(roles: Bytes, frame: Frame, settings: Settings, guards: bool) -> bool:
    """Whether a beam would cover a visible agent; with `guards`, one that is near a visible apple."""
    for side in range(-settings.beam_half_width, settings.beam_half_width + 1):
        cell = frame.own + side
        for _ in range(settings.beam_length):
            cell -= frame.stride
            if roles[cell] == WALL:
                break
            if roles[cell] == AGENT and (not guards or apples_near(roles, frame, cell) > 0):
                return True
    return False


def pursue(roles: Bytes, frame: Frame, number: float, settings: Settings, scratch: Scratch) -> int:
    """Turns towards the nearest reachable agent or walks towards it; -1 if there is none."""
    for cell in frame.cells:
        scratch.targets[cell] = roles[cell] == AGENT
    goal = nearest(frame, scratch)
    if goal < 0:
        return -1
    middle = frame.own % frame.stride
    ahead, side = frame.own // frame.stride - goal // frame.stride, goal % frame.stride - middle
    if abs(side) > ahead:
        return TURN_RIGHT if side > 0 else TURN_LEFT
    return walk_to(roles, frame, goal, number, settings, scratch)


def choose(
    policy: int, roles: Bytes, frame: Frame, numbers: Numbers, settings: Settings, scratch: Scratch
) -> int:
    """The action of one agent.

    Args:
        policy: RANDOM, GREEDY, ...
        roles: uint8 [cells], the roles of the cells of its framed window.
        frame: The layout of the framed window.
        numbers: float64 [NUMBERS], uniform random numbers in [0, 1).
        settings: The properties of the game.
        scratch: Working memory.
    """
    if policy == RANDOM:
        return int(numbers[WHICH] * settings.actions)
    fires = policy in (TERRITORIAL, AGGRESSIVE) and settings.has_beam
    if fires and has_target(roles, frame, settings, policy == TERRITORIAL):
        return BEAM
    target_apples(roles, frame, scratch)
    if policy == SUSTAINABLE:
        exclude_sparse_apples(roles, frame, settings, scratch)
    elif policy == PACIFIST:
        exclude_apples_nearer_to_others(roles, frame, scratch)
    count_own_steps(roles, frame, scratch)
    if policy == AGGRESSIVE:
        action = pursue(roles, frame, numbers[WAITS], settings, scratch)
        if action >= 0:
            return action
        target_apples(roles, frame, scratch)
    goal = nearest(frame, scratch)
    if goal < 0:
        return wander(roles, frame, numbers[WANDERS], scratch)
    return walk_to(roles, frame, goal, numbers[WAITS], settings, scratch)


def choose_all(
    policy: int,
    epsilon: float,
    roles: Bytes,
    frame: Frame,
    numbers: Numbers,
    settings: Settings,
    scratch: Scratch,
    chosen: Actions,
) -> None:
    """The actions of n agents; each is random with probability `epsilon`.

    Args:
        policy: RANDOM, GREEDY, ...
        epsilon: The probability of a random action.
        roles: uint8 [n, cells], the roles of the cells of each framed window.
        frame: The layout of all framed windows.
        numbers: float64 [n, NUMBERS], uniform random numbers in [0, 1).
        settings: The properties of the game.
        scratch: Working memory.
        chosen: int64 [n], receives the actions.
    """
    for n in range(roles.shape[0]):
        explores = numbers[n, EXPLORES] < epsilon
        chosen[n] = choose(RANDOM if explores else policy, roles[n], frame, numbers[n], settings, scratch)
