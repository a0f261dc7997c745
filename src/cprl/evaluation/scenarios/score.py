"""Score, Scores: what a run's agents, and others in their places, reached in scenarios."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from statistics import fmean
from typing import Final, Literal, TypeAlias, get_args

import numpy as np
import pyarrow as pa

from cprl import arguments
from cprl.evaluation.lanes import Played, pooled
from cprl.evaluation.scenarios.scenario import Scenario
from cprl.measuring.replicas import Measured, institution_measures, over_replicas, social_measures
from cprl.measuring.statistics import Estimate, difference
from cprl.runs.labelled import labelled
from cprl.stored import LoadedRun

FocalAgents: TypeAlias = Literal["run", "random", "greedy"]
"""Who takes the focal places: the run's agents, or agents that follow a scripted policy."""
FOCAL_AGENTS: Final[tuple[FocalAgents, ...]] = get_args(FocalAgents)

Whose: TypeAlias = Literal["focal", "background"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Score:
    """The episodes of one scenario."""

    scenario: Scenario
    played: Mapping[FocalAgents, Mapping[tuple[int, ...], Played]] = field(repr=False)
    """The episodes by who is focal, the indices of the focal agents, and the replica."""

    def measures(self, focal: FocalAgents = "run") -> dict[str, Measured]:
        """focal/return and background/return, the mean return of a focal and of a background agent, then the
        social metrics of all agents together, and those of institutions as `institutions/fines` and so on;
        intervals by Student's t.

        Args:
            focal: who takes the focal places, one of `FOCAL_AGENTS`.

        Raises:
            ValueError: if it is anything else.
        """
        together = pooled(self._of(focal).values())
        return {
            "focal/return": over_replicas(self.returns("focal", focal)),
            "background/return": over_replicas(self.returns("background", focal)),
            **social_measures(together),
            **institution_measures(together),
        }

    def returns(self, whose: Whose, focal: FocalAgents = "run") -> dict[int, list[float]]:
        """The mean return per agent by replica, of each episode of each placement.

        Args:
            whose: "focal" or "background".
            focal: who takes the focal places.

        Raises:
            ValueError: if a word is another one.
        """
        arguments.choice("whose", whose, get_args(Whose))
        values: dict[int, list[float]] = {}
        for places, played in self._of(focal).items():
            rest = np.setdiff1d(np.arange(self.scenario.game.agents), places)
            agents = list(places) if whose == "focal" else rest.tolist()
            for replica, episodes in played.items():
                own = (float(episode.return_[agents].mean()) for episode in episodes)
                values.setdefault(replica, []).extend(own)
        return values

    def advantage(self, over: FocalAgents, *, whose: Whose = "focal") -> Estimate:
        """What the run's agents get more than others would in their places; or what the background gets
        more among them. Paired by replica, which plays the same worlds; the interval is by Student's t.

        Args:
            over: "random" or "greedy".
            whose: "focal" or "background".

        Raises:
            ValueError: if a word is another one.
        """
        own, other = self.returns(whose), self.returns(whose, over)
        means = [[fmean(values[replica]) for replica in own] for values in (own, other)]
        return difference(*means, paired=True)

    def _of(self, focal: FocalAgents) -> Mapping[tuple[int, ...], Played]:
        arguments.choice("focal", focal, FOCAL_AGENTS)
        return self.played[focal]


@dataclass(frozen=True, kw_only=True, eq=False)
class Scores:
    """What a run reached in scenarios."""

    run: LoadedRun
    by_scenario: Mapping[str, Score] = field(repr=False)
    """The scores by the name of the scenario."""
    replicas: list[int]
    episodes: int
    """Episodes of each replica in each placement."""
    seed: int
    greedy: bool
    left_out: str
    """Which named scenarios of the game were not at hand and why; "" if none was, or others were asked
    for."""

    def table(self) -> pa.Table:
        """All episodes with the columns of `episodes.parquet`, after "scenario", "focal" (who takes the focal
        places: "run", "random" or "greedy") and "focal_agents" (their indices, e.g. "0 2 3")."""
        return labelled(
            (
                {"scenario": name, "focal": focal, "focal_agents": " ".join(map(str, places))},
                replica,
                episodes,
            )
            for name, score in self.by_scenario.items()
            for focal, by_places in score.played.items()
            for places, played in by_places.items()
            for replica, episodes in played.items()
        )
