"""The study's claims, each with a measure, its interval over replicas and a verdict."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cprl.measuring.predictions import prediction
from cprl.measuring.shares import share
from cprl.measuring.statistics import difference, estimate
from cprl.reporting import verdicts
from cprl.reporting.result import TOO_FEW

Values = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Claim:
    """A claim of the study beside a run of ours, as a row of a table."""

    claim: str
    measure: str
    published: str
    """What the study's own figures say; "" where they cannot."""
    ours: str
    verdict: str


def number(claim: str, measure: str, values: Values, *, published: float) -> Claim:
    """A number that the study's figures give, beside the prediction interval of one run.

    Args:
        claim: what the study says.
        measure: what is measured.
        values: of each replica, [R].
        published: the same of the published curve.
    """
    return Claim(
        claim=claim,
        measure=measure,
        published=f"{published:.4g}",
        ours=f"{with_interval(values)}, one run {prediction(values)}",
        verdict=verdicts.of_number(published, values),
    )


def side(
    claim: str,
    measure: str,
    values: Values,
    *,
    above: float | None = None,
    below: float | None = None,
    published: float | None = None,
) -> Claim:
    """A mean that is claimed to lie above or below a bound; see `verdicts.of_claim`."""
    found = estimate(values)
    return Claim(
        claim=claim,
        measure=measure,
        published="" if published is None else f"{published:.4g}",
        ours=with_interval(values),
        verdict=verdicts.of_claim(found.low, found.high, above=above, below=below, replicas=len(values)),
    )


def more(claim: str, measure: str, values: Values, reference: Values, *, paired: bool) -> Claim:
    """A mean that is claimed to exceed another one, [R] each; see `verdicts.of_claim`."""
    found = difference(values, reference, paired=paired)
    return Claim(
        claim=claim,
        measure=measure,
        published="",
        ours=f"{values.mean():.4g} and {reference.mean():.4g}, difference {found}",
        verdict=verdicts.of_claim(found.low, found.high, above=0, replicas=min(len(values), len(reference))),
    )


def alike(claim: str, measure: str, values: Values, *, within: tuple[float, float]) -> Claim:
    """A mean that is claimed to lie between two bounds; see `verdicts.of_likeness`."""
    found = estimate(values)
    return Claim(
        claim=claim,
        measure=f"{measure}, alike if {within[0]:g} to {within[1]:g}",
        published="",
        ours=with_interval(values),
        verdict=verdicts.of_likeness(found.low, found.high, within=within, replicas=len(values)),
    )


def rule(claim: str, measure: str, shown: NDArray[Any]) -> Claim:
    """What more than half of all runs are claimed to show, bool [R]; see `verdicts.of_share`."""
    found = share(int(shown.sum()), len(shown))
    return Claim(
        claim=claim,
        measure=f"{measure}; share of replicas",
        published="",
        ours=f"{found}",
        verdict=verdicts.of_share(found),
    )


def where(is_long: bool, claim: Claim) -> Claim:
    """A claim; its verdict says so where the training is too short for it."""
    return claim if is_long else replace(claim, verdict=TOO_FEW)


def with_interval(values: Values) -> str:
    """The mean of replicas, [R], with its 95 % interval by Student's t."""
    return f"{estimate(values)}"


def undefined_in(values: Values) -> str:
    """In how many episodes a metric is undefined, which are in no mean, [R, E]; "" in none."""
    count = int(np.isnan(values).sum())
    return f", undefined in {count:,} of {values.size:,} episodes" if count else ""


def rows_of(claims: Sequence[Claim]) -> list[list[str]]:
    """The cells of a table of claims; see `HEAD`."""
    return [[one.claim, one.measure, one.published, one.ours, one.verdict] for one in claims]


HEAD = ["claim", "measure", "published", "ours", "verdict"]
"""The head of a table of claims."""
