"""Metrics of episodes of several replicas: estimates over replicas, and counts of undefined values."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isnan
from numbers import Real
from statistics import fmean

from cprl import arguments
from cprl.measuring.episodes import Episode
from cprl.measuring.statistics import Estimate, estimate


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


def over_replicas(values: Mapping[int, Sequence[float]]) -> Measured:
    """Estimates a metric from its values by replica, one per episode, NaN where undefined.

    Args:
        values: the values by replica.

    Raises:
        ValueError: if there are no replicas, or a replica has no episodes.
    """
    arguments.object_of("values", values, Mapping, "a table of values by replica")
    for replica, of_replica in values.items():
        for value in arguments.listed(f"values[{replica!r}]", of_replica, "one number per episode"):
            arguments.object_of(f"values[{replica!r}]", value, Real, "one number per episode")
    if not values or not all(map(len, values.values())):
        counts = {replica: len(own) for replica, own in values.items()}
        raise ValueError(f"episodes by replica are {counts}; allowed: at least one replica, each at least 1")
    defined = [[value for value in own if not isnan(value)] for own in values.values()]
    means = [fmean(own) for own in defined if own]
    episodes = sum(map(len, values.values()))
    return Measured(
        estimate=estimate(means) if means else None,
        undefined=episodes - sum(map(len, defined)),
        episodes=episodes,
    )


def social_metrics(episode: Episode) -> dict[str, float]:
    """Each of "Social metrics" in docs/metrics.md by name, NaN where undefined.

    Metrics that need entries that the game does not report are left out.
    """
    arguments.object_of("episode", episode, Episode, "an Episode")
    if episode.stock_left is None:
        return dict(episode.metrics)
    return {**episode.metrics, "stock_left": float(episode.stock_left)}


def institution_metrics(episode: Episode) -> dict[str, float]:
    """Each of "Institutions" in docs/metrics.md by name, NaN where undefined: `Episode.institutions`, and
    what was decided, `in_force_0` and so on. Empty for a game without institutions."""
    arguments.object_of("episode", episode, Episode, "an Episode")
    in_force: list[float] = [] if episode.in_force is None else episode.in_force.tolist()
    return {**episode.institutions, **{f"in_force_{nth}": value for nth, value in enumerate(in_force)}}


def institution_measures(played: Mapping[int, Sequence[Episode]]) -> dict[str, Measured]:
    """`institution_metrics` over replicas, by name, as `institutions/fines` and so on; empty for a game
    without institutions.

    Args:
        played: episodes by replica.

    Raises:
        ValueError: see `over_replicas`.
    """
    by_replica = {
        replica: [institution_metrics(episode) for episode in own]
        for replica, own in _checked(played).items()
    }
    names = next((own[0] for own in by_replica.values() if own), {})
    return {
        f"institutions/{name}": over_replicas(
            {replica: [metrics[name] for metrics in own] for replica, own in by_replica.items()},
        )
        for name in names
    }


def social_measures(played: Mapping[int, Sequence[Episode]]) -> dict[str, Measured]:
    """`social_metrics` over replicas, by name.

    Args:
        played: episodes by replica.

    Raises:
        ValueError: see `over_replicas`.
    """
    metrics_by_replica = {
        replica: [social_metrics(episode) for episode in own] for replica, own in _checked(played).items()
    }
    names = next((own[0] for own in metrics_by_replica.values() if own), {})
    return {
        name: over_replicas(
            {replica: [metrics[name] for metrics in own] for replica, own in metrics_by_replica.items()},
        )
        for name in names or ("survival_steps",)  # every game has it; without episodes it raises the error
    }


def _checked(played: Mapping[int, Sequence[Episode]]) -> Mapping[int, Sequence[Episode]]:
    """Episodes by replica, after checking that they are."""
    arguments.object_of("played", played, Mapping, "a table of episodes by replica")
    for replica, own in played.items():
        for episode in arguments.listed(f"played[{replica!r}]", own, "a sequence of episodes"):
            arguments.object_of(f"an entry of played[{replica!r}]", episode, Episode, "an Episode")
    return played


def agents_without_harvest(played: Mapping[int, Sequence[Episode]]) -> tuple[int, int] | None:
    """Counts the agents of all episodes without a harvest, which sustainability leaves out, and all agents.

    None if the game reports no harvest.
    """
    harvests: list[float] = []
    for episode in (episode for own in _checked(played).values() for episode in own):
        if episode.harvest is None:
            return None
        harvests += episode.harvest.tolist()
    return sum(apples == 0 for apples in harvests), len(harvests)
