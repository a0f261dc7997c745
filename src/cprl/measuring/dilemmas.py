"""dilemma: which social dilemma payoffs make, by the margins at both ends of a Schelling diagram.

R(k) is what an agent gets that restrains itself while k of the N - 1 others do, G(k) what it gets if it is
greedy instead. There is a dilemma if all agents prefer restraint of all to greed of all, R(N-1) > G(0), and
to being the only one who restrains itself, R(N-1) > R(0), and yet one of two things pulls an agent from it:

    fear    G(0) > R(0): who meets greedy agents only had better be greedy
    greed   G(N-1) > R(N-1): who meets restrained agents only had better be greedy

With both it is a prisoner's dilemma, with greed alone chicken, with fear alone a stag hunt.

Sources: T. C. Schelling, "Hockey Helmets, Concealed Weapons, and Daylight Saving" (1973); M. W. Macy and
A. Flache, "Learning dynamics in social dilemmas" (2002), for the names; E. Hughes et al., "Inequity aversion
improves cooperation in intertemporal social dilemmas" (2018), for N agents.
"""

from collections.abc import Iterator
from dataclasses import dataclass, fields
from itertools import product
from math import isnan
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cprl.measuring.statistics import Estimate, difference

Values = NDArray[np.float64]

NONE: Final = "no dilemma"
UNTOLD: Final = "cannot be told"
_ALL: Final = 4
"""The number of names: three dilemmas, and none."""


@dataclass(frozen=True, kw_only=True)
class Dilemma:
    """The margins of a Schelling diagram, over replicas, in the unit of the payoffs."""

    restraint: Estimate
    """R(N-1) - G(0): what an agent gains if all restrain themselves instead of none."""
    company: Estimate
    """R(N-1) - R(0): what a restrained agent gains if all others are restrained, too."""
    fear: Estimate
    """G(0) - R(0)."""
    greed: Estimate
    """G(N-1) - R(N-1)."""

    @property
    def candidates(self) -> tuple[str, ...]:
        """The dilemmas that the intervals allow, most likely first: one where they tell which it is."""
        margins = [getattr(self, field.name) for field in fields(self)]
        likely = _name(*(estimate.value > 0 for estimate in margins))
        return tuple(dict.fromkeys((likely, *(_name(*signs) for signs in product(*map(_signs, margins))))))

    @property
    def name(self) -> str:
        """The dilemma, or those that it may be."""
        return " or ".join(self.candidates) if len(self.candidates) < _ALL else UNTOLD


def dilemma(restrained: Values, greedy: Values) -> Dilemma:
    """Which dilemma payoffs make.

    Args:
        restrained: R(k), float [R, N]: of each of R replicas, for k = 0 to N - 1 others that are restrained.
        greedy: G(k), likewise. Replicas are paired.
    """
    if restrained.ndim != 2 or restrained.shape != greedy.shape or restrained.shape[1] < 2:
        raise ValueError(
            f"restrained is {list(restrained.shape)} and greedy {list(greedy.shape)}; allowed: [R, N] both, "
            "at least 2 agents"
        )
    pairs = {
        "restraint": (restrained[:, -1], greedy[:, 0]),
        "company": (restrained[:, -1], restrained[:, 0]),
        "fear": (greedy[:, 0], restrained[:, 0]),
        "greed": (greedy[:, -1], restrained[:, -1]),
    }
    return Dilemma(**{name: difference(*pair, paired=True) for name, pair in pairs.items()})


def _name(restraint: bool, company: bool, fear: bool, greed: bool) -> str:
    if not (restraint and company and (fear or greed)):
        return NONE
    return "prisoner's dilemma" if fear and greed else "chicken" if greed else "stag hunt"


def _signs(margin: Estimate) -> Iterator[bool]:
    """Whether a margin is above 0, in all ways that its interval allows; without an interval both."""
    if isnan(margin.low) or margin.high > 0:
        yield True
    if isnan(margin.low) or margin.low <= 0:
        yield False
