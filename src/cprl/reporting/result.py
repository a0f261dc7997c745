"""What a finished run left, as far as a report needs it."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cprl.measuring import phases
from cprl.measuring.published import Experiment, experiment
from cprl.runs.curves import curves_of, running_mean
from cprl.runs.directory import read_json, read_recipe

Values = NDArray[np.float64]

TOO_FEW: Final = "too few episodes"


@dataclass(kw_only=True, eq=False)
class Result:
    """What a run left, as far as a report needs it."""

    path: Path
    recipe: Mapping[str, Any]
    told: Mapping[str, Any]
    """`report.json`."""
    curves: Mapping[str, Values]
    study: Experiment | None
    """The study's experiment that its recipe repeats."""

    @property
    def name(self) -> str:
        """That of its directory."""
        return self.path.name

    @property
    def title(self) -> str:
        """What was run, in a few words."""
        arguments, (replicas, episodes) = self.recipe["arguments"], self.curves["collective_return"].shape
        told = [self.recipe["recipe"]]
        if "variant" in arguments:
            told.append(f"{arguments['variant']} rules")
        if "learner" in arguments:
            told.append(f"targets replaced every {arguments['learner']['target_every_episodes']} episodes")
            told.append(f"epsilon decays in {arguments['learner']['epsilon_decay_steps']:,} steps")
        return ", ".join([*told, f"{replicas} replicas of {episodes:,} episodes"])

    @cached_property
    def phases(self) -> tuple[list[phases.ChangePoint], list[phases.Phase]] | None:
        """As those of experiment 5 are told; None where there are too few episodes."""
        smoothed = {name: running_mean(self.curves[name]) for name in phases.METRICS}
        episodes = np.arange(smoothed["equality"].shape[1])
        if len(episodes) <= 4 * phases.SHORTEST:
            return None
        return phases.told_apart(episodes, smoothed)


def read_result(path: Path) -> Result:
    """A run's directory, or its results.

    Raises:
        ValueError: where there is no run.
        FileNotFoundError: where it has no episodes or did not end.
    """
    recipe = read_recipe(path)
    return Result(
        path=path,
        recipe=recipe,
        told=read_json(path / "report.json"),
        curves=curves_of(path),
        study=experiment(recipe["recipe"]),
    )
