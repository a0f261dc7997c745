"""What apples can bear on a board of a few sites, exactly, if a harvester visits so many cells a turn.

`yield_bounds` has bounds for any board.
"""

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cprl.commons.maps import Map
from cprl.commons.near import neighbours
from cprl.commons.rules import Rules

MOST_SITES: Final = 7
"""Of a board whose yield is computed exactly: there are 2**K stocks, and as many sets of cells to visit."""
TOLERANCE: Final = 1e-9
"""Apples per turn by which the best policy may be better than the one that is found."""
_ROUNDS_AT_ONCE: Final = 500
_MOST_ROUNDS: Final = 100
_SHARE: Final = 0.9
"""Of turns in which time passes: in the others all stays as it is, so that no policy goes round in circles,
which changes neither the best policy nor its yield per turn (Schweitzer 1971)."""
_DOUBLINGS: Final = 40
"""Of the turns after which a policy is in its long run."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class ExactYield:
    """What a board bears for ever, harvested as well as can be."""

    per_step: float
    """Apples per turn in the long run, from a full stock on."""
    kept: float
    """Apples that are left after the bites of a turn, in the long run."""


def exact_yield(
    board: Map, rules: Rules, *, bites_per_step: int | None = None, sees_growth: bool = False
) -> ExactYield:
    """The largest long-run harvest of a few sites, by value iteration over all their stocks.

    Before each turn a set of sites is chosen by the stock, and every apple there is bitten, also one that
    grows in this turn where the rules let it be (growth "before_bites"). An isolated cross under the
    published probabilities bears 0.1 apples a turn as run, 3 of its 5 being kept; with one bite a turn
    0.0975, or 0.09987 if the harvester chooses once it has seen what grew. Ways, clashes and beams are
    left out: the harvester is where it wants to be. The policy found is evaluated exactly, and proven to be
    within `TOLERANCE` of the best by the largest gain of a round (Odoni 1969, for value iteration).

    Args:
        board: the map, of up to 7 sites.
        rules: its rules.
        bites_per_step: sites that can be visited in a turn; by default all.
        sees_growth: whether the sites are chosen after the turn's growth, where that is before the bites.

    Raises:
        ValueError: for more sites, and for a number of bites below 1.
        RuntimeError: where no policy is proven best, since apples hardly ever grow.
    """
    sites = len(board.sites)
    if sites > MOST_SITES:
        raise ValueError(f"the board has {sites} sites; allowed: up to {MOST_SITES}")
    most = sites if bites_per_step is None else bites_per_step
    moves = _moves(board, rules, most, sees_growth)
    values = np.zeros(2**sites)
    for _ in range(_MOST_ROUNDS):
        for _ in range(_ROUNDS_AT_ONCE):
            worth = _SHARE * (moves.bitten + moves.chances @ values) + (1 - _SHARE) * values
            gains, values = (worth.max(0) - values) / _SHARE, worth.max(0)
        policy = worth.argmax(0), np.arange(len(values))
        long_run = _long_run(moves.chances[policy])
        found = float(long_run @ moves.bitten[policy])
        if gains.max() - found < TOLERANCE:
            return ExactYield(per_step=found, kept=float(long_run @ moves.left[policy]))
    raise RuntimeError(f"no policy was proven best in {_MOST_ROUNDS * _ROUNDS_AT_ONCE:,} rounds")


def _growth(board: Map, rules: Rules) -> Floats:
    """The probability that apples grow on exactly these sites in a turn, [2**K, 2**K]: by the stock, by the
    set of such sites."""
    sites = len(board.sites)
    first, near = neighbours(board, rules)
    is_full = _bits(sites)
    counts = np.stack([is_full[:, near[first[k] : first[k + 1]].astype(int)].sum(1) for k in range(sites)], 1)
    probs = np.array(rules.regrow_prob)
    each = np.where(is_full, 0.0, probs[np.minimum(counts, len(probs) - 1)])
    sets: Floats = np.where(is_full[None], each[:, None], 1 - each[:, None]).prod(-1)
    return sets


def _bits(sites: int) -> NDArray[np.bool_]:
    """Which sites each number stands for, [2**K, K]."""
    found: NDArray[np.bool_] = (np.arange(2**sites)[:, None] >> np.arange(sites) & 1).astype(np.bool_)
    return found


class _Moves(NamedTuple):
    """What follows on visiting each set of sites at each stock."""

    chances: Floats
    """The probability of each next stock, [A, 2**K, 2**K]."""
    bitten: Floats
    """The mean number of apples bitten, [A, 2**K]."""
    left: Floats
    """The mean number of apples that the bites leave, [A, 2**K]."""


def _moves(board: Map, rules: Rules, most: int, sees_growth: bool) -> _Moves:
    """All moves; stocks are those at which the sites to visit are chosen."""
    sites = len(board.sites)
    every, apples = np.arange(2**sites), _bits(sites).sum(1)
    stocks, grown = np.broadcast_arrays(every[:, None], every)
    growth, made = _growth(board, rules), []
    is_before = rules.growth == "before_bites"
    for visited in (own for own in range(2**sites) if own.bit_count() <= most):
        there = stocks | grown if is_before and not sees_growth else stocks
        left = there & ~visited
        sets = growth[left[:, 0]] if is_before and sees_growth else growth
        after = left if there is not stocks else left | grown
        chances = np.zeros(growth.shape)
        np.add.at(chances, (stocks, after), sets)
        made.append((chances, (sets * apples[there & visited]).sum(1), (sets * apples[left]).sum(1)))
    return _Moves(*(np.stack(own) for own in zip(*made, strict=True)))


def _long_run(moves: Floats) -> Floats:
    """How often each stock is met in the long run, from a full one on, [2**K], by moves [2**K, 2**K]."""
    moves = _SHARE * moves + (1 - _SHARE) * np.eye(len(moves))
    for _ in range(_DOUBLINGS):
        moves = moves @ moves
        moves /= moves.sum(1, keepdims=True)
    found: Floats = moves[-1]
    return found
