"""How scripted agents choose, by what ONE window shows; `cprl.policies.scripted` says each manner in words.

Plain functions, which `cprl.policies.scripted` has compiled; cells and framed windows as in
`cprl.policies.paths`.
"""

from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cprl.commons.world import Actions, Bytes
from cprl.policies import paths
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
"""Indices into `cprl.commons.rules.ACTIONS`; the last action of a game is to stay."""

EXPLORES, WHICH, WANDERS, WAITS, NUMBERS = range(5)
"""What an agent's random numbers of a turn are for, and how many there are."""

WALK_ON_CHANCE: Final = 0.9
"""That one who wanders goes on ahead where it can."""
WAIT_CHANCE: Final = 0.5
"""That an agent waits where another may want the same cell, since then neither gets it (docs/game.md)."""

Numbers: TypeAlias = NDArray[np.float64]


class Terms(NamedTuple):
    """What of the game an agent's choice depends on besides what it sees."""

    actions: int
    has_beam: bool
    beam_length: int
    """Cells ahead that a beam covers whatever the heading, which the agent does not know, as far as a window
    shows them."""
    beam_half_width: int
    """Cells to each side that it covers, likewise."""
    spare: int
    """Apples that have to stay near an apple that "sustainable" bites."""


def want_apples(roles: Bytes, frame: Frame, scratch: Scratch) -> None:
    """All apples are wanted; nobody walks through another agent."""
    for cell in frame.cells:
        scratch.wanted[cell] = roles[cell] == APPLE
        scratch.shut[cell] = roles[cell] == AGENT


def leave_hanging(scratch: Scratch, cell: int) -> None:
    """An apple is neither wanted nor walked over."""
    scratch.wanted[cell] = False
    scratch.shut[cell] = True


def spare_last_apples(roles: Bytes, frame: Frame, terms: Terms, scratch: Scratch) -> None:
    """Leaves apples near which fewer others than `spare` would stay."""
    for cell in frame.cells:
        if scratch.wanted[cell] and apples_near(roles, frame, cell) < terms.spare:
            leave_hanging(scratch, cell)


def yield_to_the_nearer(roles: Bytes, frame: Frame, scratch: Scratch) -> None:
    """Leaves apples to which another has fewer steps to go."""
    count_own_steps(roles, frame, scratch)
    count_others_steps(roles, frame, scratch)
    for cell in frame.cells:
        if scratch.wanted[cell] and 0 <= scratch.others_steps[cell] < scratch.steps[cell]:
            leave_hanging(scratch, cell)


def walk_to(roles: Bytes, frame: Frame, goal: int, number: float, terms: Terms, scratch: Scratch) -> int:
    """The first step of a shortest way to a cell in reach; beside another agent it may wait."""
    cell = step_to(frame, goal, scratch)
    if is_beside_an_agent(roles, frame, cell) and number < WAIT_CHANCE:
        return terms.actions - 1
    if cell == frame.own - 1:
        return LEFT
    return RIGHT if cell == frame.own + 1 else FORWARD


def wander(roles: Bytes, frame: Frame, number: float, scratch: Scratch) -> int:
    """Mostly straight on, where the cell ahead is free; else a turn to either side."""
    ahead = frame.own - frame.stride
    if roles[ahead] <= APPLE and not scratch.shut[ahead]:
        if number < WALK_ON_CHANCE:
            return FORWARD
        number = (number - WALK_ON_CHANCE) / (1 - WALK_ON_CHANCE)
    return TURN_LEFT if number < 0.5 else TURN_RIGHT


def has_target(roles: Bytes, frame: Frame, terms: Terms, guards: bool) -> bool:
    """Whether a beam would cover another agent that is seen; if it `guards`, one near an apple in sight."""
    for side in range(-terms.beam_half_width, terms.beam_half_width + 1):
        cell = frame.own + side
        for _ in range(terms.beam_length):
            cell -= frame.stride
            if roles[cell] == WALL:
                break
            if roles[cell] == AGENT and (not guards or apples_near(roles, frame, cell) > 0):
                return True
    return False


def pursue(roles: Bytes, frame: Frame, number: float, terms: Terms, scratch: Scratch) -> int:
    """Turns to the nearest other agent in reach or walks up to it; -1 for none."""
    for cell in frame.cells:
        scratch.wanted[cell] = roles[cell] == AGENT
    goal = nearest(frame, scratch)
    if goal < 0:
        return -1
    middle = frame.own % frame.stride
    ahead, side = frame.own // frame.stride - goal // frame.stride, goal % frame.stride - middle
    if abs(side) > ahead:
        return TURN_RIGHT if side > 0 else TURN_LEFT
    return walk_to(roles, frame, goal, number, terms, scratch)


def choose(policy: int, roles: Bytes, frame: Frame, numbers: Numbers, terms: Terms, scratch: Scratch) -> int:
    """What an agent of this manner does.

    Args:
        policy: RANDOM and so on.
        roles: uint8, of the cells of its window, framed.
        frame: where they are.
        numbers: float64 [NUMBERS], random in 0..1.
        terms: of the game.
        scratch: borrowed memory.
    """
    if policy == RANDOM:
        return int(numbers[WHICH] * terms.actions)
    fires = policy in (TERRITORIAL, AGGRESSIVE) and terms.has_beam
    if fires and has_target(roles, frame, terms, policy == TERRITORIAL):
        return BEAM
    want_apples(roles, frame, scratch)
    if policy == SUSTAINABLE:
        spare_last_apples(roles, frame, terms, scratch)
    elif policy == PACIFIST:
        yield_to_the_nearer(roles, frame, scratch)
    count_own_steps(roles, frame, scratch)
    if policy == AGGRESSIVE:
        action = pursue(roles, frame, numbers[WAITS], terms, scratch)
        if action >= 0:
            return action
        want_apples(roles, frame, scratch)
    goal = nearest(frame, scratch)
    if goal < 0:
        return wander(roles, frame, numbers[WANDERS], scratch)
    return walk_to(roles, frame, goal, numbers[WAITS], terms, scratch)


def choose_all(
    policy: int,
    epsilon: float,
    roles: Bytes,
    frame: Frame,
    numbers: Numbers,
    terms: Terms,
    scratch: Scratch,
    chosen: Actions,
) -> None:
    """The choices of n agents, each with chance epsilon at random.

    Args:
        policy: RANDOM and so on.
        epsilon: the chance.
        roles: uint8 [n, cells], as in `choose`, and so on.
        frame: of all.
        numbers: float64 [n, NUMBERS].
        terms: of the game.
        scratch: borrowed memory.
        chosen: int64 [n], written.
    """
    for n in range(roles.shape[0]):
        explores = numbers[n, EXPLORES] < epsilon
        chosen[n] = choose(RANDOM if explores else policy, roles[n], frame, numbers[n], terms, scratch)


FUNCTIONS: Final[tuple[Any, ...]] = (
    *paths.FUNCTIONS,
    want_apples,
    leave_hanging,
    spare_last_apples,
    yield_to_the_nearer,
    walk_to,
    wander,
    has_target,
    pursue,
    choose,
    choose_all,
)
"""In the order in which they call each other."""
