"""What did the study of 2019 publish? The table of appendix A, and training curves.

Source: M. Wiatrak, "Governing the Commons with Multi-Agent Reinforcement Learning" (2019), appendix A and the
figures of its experiments, digitised at about 830 points each. The study does not say over how many episodes
its running means are; docs/results/details.md says how the curves do.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
from pyarrow import csv

from cprl.commons.named_games import Board
from cprl.measuring.table import where
from cprl.values.array_types import Float64


@dataclass(frozen=True, kw_only=True)
class PublishedExperiment:
    """An experiment of the study, a row of its appendix A."""

    number: int
    recipe: str
    """The name of our recipe, in recipes/."""
    board: Board
    """The board that it plays on, see `cprl.presets.game`."""
    random: float | None
    """The mean collective return of the random policy; None for experiment 4, where the study gives none."""
    trained: float
    """The mean collective return over training."""
    episodes: int
    """The number of episodes in the study's figures."""
    window_episodes: int
    """The window of its running means: the one whose spectrum has its nulls where those of the published
    curves have theirs."""
    curves: Mapping[str, str]
    """The experiment and the metric of published curves by our name of the metric; `return_0` is the return
    of agent 0."""

    def curve(self, metric: str) -> tuple[Float64, Float64]:
        """Return the episodes and the values of a published curve, float64 [points] each."""
        experiment, name = self.curves[metric].split("/")
        points = where(_points(), experiment=experiment, metric=name)
        return points["episode"].to_numpy(), points["value"].to_numpy()

    def drawn_at(self, metric: str, episodes: Float64) -> Float64:
        """Return a published curve at these episodes, between its points in straight lines."""
        return np.interp(episodes, *self.curve(metric))


EXPERIMENTS: Final = (
    PublishedExperiment(
        number=1,
        recipe="single_basic",
        board="single_basic",
        random=32.47,
        trained=174.65,
        episodes=6000,
        window_episodes=150,
        curves={"collective_return": "exp1/return"},
    ),
    PublishedExperiment(
        number=2,
        recipe="single_complex",
        board="single_complex",
        random=59.53,
        trained=177.45,
        episodes=6000,
        window_episodes=50,
        curves={"collective_return": "exp2/return"},
    ),
    PublishedExperiment(
        number=3,
        recipe="two_complex",
        board="two_complex",
        random=92.57,
        trained=191.72,
        episodes=6000,
        window_episodes=150,
        curves={"collective_return": "exp3/return"},
    ),
    PublishedExperiment(
        number=4,
        recipe="two_against_random",
        board="two_complex",
        random=None,
        trained=184.07,
        episodes=6000,
        window_episodes=50,
        curves={
            "collective_return": "exp4/return",
            "return_0": "exp4_agents/return_dqn",
            "return_1": "exp4_agents/return_random",
        },
    ),
    PublishedExperiment(
        number=5,
        recipe="commons",
        board="commons",
        random=264.53,
        trained=491.17,
        episodes=4800,
        window_episodes=30,
        curves={
            "collective_return": "exp5/efficiency",
            "equality": "exp5/equality",
            "survival_steps": "exp5/sustainability",
            "peacefulness": "exp5/peacefulness",
        },
    ),
)


EXPERIMENT_5: Final = EXPERIMENTS[-1]
"""The only one whose phases the study draws."""


def published_experiment(recipe: str) -> PublishedExperiment | None:
    """Return the study's experiment that a recipe repeats, or None."""
    return next((one for one in EXPERIMENTS if one.recipe == recipe), None)


@cache
def _points() -> pa.Table:
    table = csv.read_csv(Path(__file__).parent / "published_curves.csv")
    return table.sort_by([("episode", "ascending"), ("value", "ascending")])
