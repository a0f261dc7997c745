"""The published results: the table of appendix A and the training curves.

Source: M. Wiatrak, "Governing the Commons with Multi-Agent Reinforcement Learning" (2019), appendix A and the
figures of its experiments, digitised at about 830 points each.
"""

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cprl import arguments
from cprl.presets import Board

Values = NDArray[np.float64]

SMOOTHED_EPISODES: Final = 100
"""The window of our running means in episodes, where nothing else is asked for. Beside a published curve it
is that curve's, `PublishedExperiment.window_episodes`. All are drawn at the first episode of a window."""
PHASED_RECIPE: Final = "commons"
"""Our recipe of experiment 5, the only one whose phases the study draws."""
PHASES_BEGIN: Final = (450, 1500, 2400)
"""The episodes at which tragedy, combat and cultivation begin in the study's figures of experiment 5."""


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
    """The window of the study's running means. It gives none: this one has its nulls where the spectra of the
    published curves have theirs, see `cprl.measuring.running_means`."""
    curves: Mapping[str, str]
    """The names of published curves by our name of the metric; `return_0` is the return of agent 0."""


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


def published_experiment(recipe: str) -> PublishedExperiment | None:
    """The study's experiment that a recipe repeats, or None."""
    arguments.object_of("recipe", recipe, str, "the name of a recipe")
    return next((one for one in EXPERIMENTS if one.recipe == recipe), None)


def curve(name: str) -> tuple[Values, Values]:
    """A published curve: its episodes and its values, float64 [points] each.

    Args:
        name: as in `PublishedExperiment.curves`.

    Raises:
        ValueError: If there is no curve of this name.
    """
    arguments.choice("name", name, _curves())
    return _curves()[name]


@cache
def _curves() -> dict[str, tuple[Values, Values]]:
    points: dict[str, list[tuple[float, float]]] = {}
    with (files("cprl.measuring") / "published_curves.csv").open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            name = f"{row['experiment']}/{row['metric']}"
            points.setdefault(name, []).append((float(row["episode"]), float(row["value"])))
    found = {name: np.array(sorted(of_curve)) for name, of_curve in points.items()}
    return {name: (values[:, 0], values[:, 1]) for name, values in found.items()}


def agreement(name: str, values: Values) -> tuple[float, float]:
    """Pearson's correlation and the mean absolute difference between a curve of ours and a published one.

    Args:
        name: The name of the published curve.
        values: Our curve, [E] from episode 0 on, smoothed in the same way. Only episodes that both curves
            have are compared.

    Raises:
        ValueError: If the published curve has fewer than 10 points in these episodes, or `values` is not [E].
    """
    episodes, published = curve(name)
    values = arguments.floats("values", values)
    if values.ndim != 1:
        raise ValueError(f"values is {list(values.shape)}; allowed: [E], one number per episode")
    both = episodes <= len(values) - 1
    if both.sum() < 10:
        raise ValueError(f"{len(values)} episodes have {both.sum()} points of {name}; allowed: at least 10")
    ours = np.interp(episodes[both], np.arange(len(values)), values)
    return float(np.corrcoef(ours, published[both])[0, 1]), float(np.abs(ours - published[both]).mean())
