"""Shares of replicas that show something, with exact intervals."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from cprl import arguments

CONFIDENCE: Final = 0.95
_BELOW_ONE: Final = np.nextafter(1.0, 0.0).item()


@dataclass(frozen=True, kw_only=True)
class Share:
    """How many of some replicas show something."""

    shown: int
    replicas: int
    low: float
    high: float
    """The bounds of the interval of the probability that a replica shows it, 0 to 1."""

    @property
    def value(self) -> float:
        """The share, 0 to 1."""
        return self.shown / self.replicas

    def __str__(self) -> str:
        """For example "2 of 8 [0.03, 0.65]"."""
        return f"{self.shown} of {self.replicas} [{self.low:.2f}, {self.high:.2f}]"


def share(shown: int, replicas: int, *, confidence: float = CONFIDENCE) -> Share:
    """A share of replicas with the interval of C. J. Clopper and E. S. Pearson, "The use of confidence or
    fiducial limits illustrated in the case of the binomial" (1934).

    The interval contains the true probability at least as often as its confidence says, however few replicas
    there are; for few it is wide.

    Args:
        shown: the replicas that show it.
        replicas: all replicas, at least 1.
        confidence: between 0 and 1, exclusive.

    Raises:
        ValueError: if a number is out of range.
    """
    from scipy import stats  # takes as long as torch

    replicas = arguments.integer("replicas", replicas, 1)
    shown = arguments.integer("shown", shown, 0, replicas)
    arguments.number("confidence", confidence, low=0, high=_BELOW_ONE, above=True, allowed="above 0, below 1")
    margin = (1 - confidence) / 2
    return Share(
        shown=shown,
        replicas=replicas,
        low=float(stats.beta.ppf(margin, shown, replicas - shown + 1)) if shown else 0.0,
        high=float(stats.beta.ppf(1 - margin, shown + 1, replicas - shown)) if shown < replicas else 1.0,
    )
