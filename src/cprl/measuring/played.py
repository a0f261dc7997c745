"""Estimates of episodes by replica: what the callers of before use until they take tables."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import inf, isfinite, isnan
from operator import attrgetter
from statistics import fmean

import numpy as np

from cprl.measuring.episodes import Episode
from cprl.measuring.statistics import CUT, ONE_REPLICA, Estimate, estimate_if_finite


@dataclass(frozen=True, kw_only=True)
class Measured:
    """A metric with one value per episode, over the episodes of several replicas."""

    estimate: Estimate | None
    """The estimate over replicas of each replica's mean over the episodes in which the metric is defined.
    Replicas without such an episode are left out; None if no replica has one."""
    undefined: int
    """Episodes of all replicas in which the metric is undefined; they are not part of a mean."""
    episodes: int
    """Episodes of all replicas."""

    def __str__(self) -> str:
        if self.estimate is None:
            return f"undefined in all {self.episodes}"
        value = f"{self.estimate}"
        return f"{value}, undefined in {self.undefined} of {self.episodes}" if self.undefined else value


def notes_on(measures: Sequence[Measured]) -> list[str]:
    """Return what a table of metrics says once of its intervals."""
    estimates = [measured.estimate for measured in measures if measured.estimate is not None]
    is_single = bool(estimates) and all(estimate.replicas == 1 for estimate in estimates)
    return [ONE_REPLICA] * is_single + [CUT] * any(estimate.is_cut for estimate in estimates)


ByReplica = Mapping[int, Sequence[float]]
"""The values of a metric by replica, at least one per episode, NaN where undefined."""


def over_replicas(values: ByReplica, metric: str = "", clock: float = inf) -> Measured:
    """Estimate a metric, which may be named, see `bounds`; a mean that is not finite has no interval."""
    means = list(_means(values).values())
    return Measured(
        estimate=estimate_if_finite(means).of(metric, clock) if means else None,
        undefined=sum(isnan(value) for episodes in values.values() for value in episodes),
        episodes=sum(map(len, values.values())),
    )


def difference_paired(
    values: ByReplica, reference: ByReplica, metric: str = "", clock: float = inf
) -> Estimate | None:
    """Return how much more the mean of a metric is, paired by replica, over the replicas in which both are
    defined; None if there is none."""
    means = _means(values)
    others = _means(reference)
    pairs = [means[replica] - others[replica] for replica in means if replica in others]
    return estimate_if_finite(pairs).between(metric, clock) if pairs else None


def _means(values: ByReplica) -> dict[int, float]:
    """Return the mean of each replica over the episodes in which the metric is defined, if there are any."""
    defined = {
        replica: [value for value in episodes if not isnan(value)] for replica, episodes in values.items()
    }
    with np.errstate(invalid="ignore"):  # of infinite values of both signs
        return {
            replica: fmean(episodes) if all(map(isfinite, episodes)) else float(np.mean(episodes))
            for replica, episodes in defined.items()
            if episodes
        }


def institution_measures(played: Mapping[int, Sequence[Episode]]) -> dict[str, Measured]:
    """Return the metrics of institutions over replicas, by name, of episodes by replica."""
    return _measures(played, attrgetter("of_institutions"))


def social_measures(played: Mapping[int, Sequence[Episode]]) -> dict[str, Measured]:
    """Return the social metrics over replicas, by name, of episodes by replica."""
    return _measures(played, attrgetter("social"))


def _measures(
    played: Mapping[int, Sequence[Episode]], metrics_of: Callable[[Episode], dict[str, float]]
) -> dict[str, Measured]:
    clock = clock_of(played)
    metrics = by_metric(played, metrics_of)
    return {name: over_replicas(values, name, clock) for name, values in metrics.items()}


def clock_of(played: Mapping[int, Sequence[Episode]]) -> float:
    """Return the steps of an episode that the clock ended, infinity where none was."""
    episodes = (episode for of_replica in played.values() for episode in of_replica)
    return max((episode.steps for episode in episodes if not episode.terminated), default=inf)


def by_metric(
    played: Mapping[int, Sequence[Episode]], metrics_of: Callable[[Episode], dict[str, float]]
) -> dict[str, dict[int, list[float]]]:
    """Return the values of each metric by replica, of episodes by replica."""
    by_replica = {replica: list(map(metrics_of, episodes)) for replica, episodes in played.items()}
    names = next(iter(by_replica.values()))[0]
    return {
        name: {replica: [one[name] for one in episodes] for replica, episodes in by_replica.items()}
        for name in names
    }


def agents_without_harvest(played: Mapping[int, Sequence[Episode]]) -> tuple[int, int] | None:
    """Count the agents of all episodes without a harvest, which sustainability leaves out, and all agents;
    None if the game reports no harvest."""
    harvests = [episode.harvest for episodes in played.values() for episode in episodes]
    apples = [apples for harvest in harvests if harvest is not None for apples in harvest.tolist()]
    return (apples.count(0), len(apples)) if apples else None
