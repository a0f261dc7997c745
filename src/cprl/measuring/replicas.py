"""A number of many episodes of many replicas: estimated over replicas, what is undefined counted apart."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isnan
from statistics import fmean

from cprl.measuring.episodes import Episode
from cprl.measuring.statistics import Estimate, estimate


@dataclass(frozen=True, kw_only=True)
class Measured:
    """A number told once an episode, of so many episodes of each replica."""

    estimate: Estimate | None
    """Of each replica's mean over the episodes in which it is defined, over the replicas that have such an
    episode; None where none has."""
    undefined: int
    """Episodes in which it is not defined, of all replicas; in no mean."""
    episodes: int
    """Of all replicas."""

    def __str__(self) -> str:
        if self.estimate is None:
            return f"undefined in all {self.episodes}"
        told = f"{self.estimate.value:.4g}" if isnan(self.estimate.low) else str(self.estimate)
        return f"{told}, undefined in {self.undefined} of {self.episodes}" if self.undefined else told


def over_replicas(values: Mapping[int, Sequence[float]]) -> Measured:
    """What values say, by replica one of each episode, NaN where undefined.

    Raises:
        ValueError: for no replicas, or a replica without episodes.
    """
    if not values or not all(map(len, values.values())):
        counts = {replica: len(own) for replica, own in values.items()}
        raise ValueError(f"episodes by replica are {counts}; at least one of at least one replica is wanted")
    defined = [[value for value in own if not isnan(value)] for own in values.values()]
    means = [fmean(own) for own in defined if own]
    episodes = sum(map(len, values.values()))
    return Measured(
        estimate=estimate(means) if means else None,
        undefined=episodes - sum(map(len, defined)),
        episodes=episodes,
    )


def social_metrics(episode: Episode) -> dict[str, float]:
    """Each of "Social metrics" in docs/metrics.md by name, NaN where undefined."""
    return {**episode.metrics, "stock_left": float(episode.stock_left)}


def social_measures(played: Mapping[int, Sequence[Episode]]) -> dict[str, Measured]:
    """`social_metrics` over replicas, by name.

    Args:
        played: episodes by replica.

    Raises:
        ValueError: see `over_replicas`.
    """
    told = {replica: [social_metrics(episode) for episode in own] for replica, own in played.items()}
    names = next((own[0] for own in told.values() if own), {})
    return {
        name: over_replicas({replica: [metrics[name] for metrics in own] for replica, own in told.items()})
        for name in names or ("collective_return",)
    }


def agents_without_harvest(played: Mapping[int, Sequence[Episode]]) -> tuple[int, int]:
    """How many agents of all episodes bit nothing, whom sustainability leaves out; and of how many."""
    harvests = [apples for own in played.values() for episode in own for apples in episode.harvest]
    return sum(apples == 0 for apples in harvests), len(harvests)
