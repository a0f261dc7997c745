"""The published figures to compare with: appendix A's table and the training curves.

Source: M. Wiatrak, "Governing the Commons with Multi-Agent Reinforcement Learning" (2019), appendix A and the
figures of its experiments, read off the figures at about 830 points each.
"""

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Final

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.float64]

SMOOTHED_EPISODES: Final = 100
"""The study's curves are means over several runs of running means over about so many episodes, drawn at the
first of them."""
PHASES_BEGIN: Final = (450, 1500, 2400)
"""Episodes of experiment 5 at which the study draws tragedy, combat and cultivation to begin."""


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """An experiment of the study, a row of its appendix A."""

    number: int
    recipe: str
    """Of ours, in recipes/."""
    random: float | None
    """The mean collective return of the random policy; the study gives none for experiment 4."""
    trained: float
    """The mean collective return over training."""
    episodes: int
    """Shown in its figures."""
    curves: Mapping[str, str]
    """Published curves by the metric of ours that they show; `return_0` is agent 0's return."""


EXPERIMENTS: Final = (
    Experiment(
        number=1,
        recipe="single_basic",
        random=32.47,
        trained=174.65,
        episodes=6000,
        curves={"collective_return": "exp1/return"},
    ),
    Experiment(
        number=2,
        recipe="single_complex",
        random=59.53,
        trained=177.45,
        episodes=6000,
        curves={"collective_return": "exp2/return"},
    ),
    Experiment(
        number=3,
        recipe="two_complex",
        random=92.57,
        trained=191.72,
        episodes=6000,
        curves={"collective_return": "exp3/return"},
    ),
    Experiment(
        number=4,
        recipe="two_against_random",
        random=None,
        trained=184.07,
        episodes=6000,
        curves={
            "collective_return": "exp4/return",
            "return_0": "exp4_agents/return_dqn",
            "return_1": "exp4_agents/return_random",
        },
    ),
    Experiment(
        number=5,
        recipe="commons",
        random=264.53,
        trained=491.17,
        episodes=4800,
        curves={
            "collective_return": "exp5/efficiency",
            "equality": "exp5/equality",
            "survival_steps": "exp5/sustainability",
            "peacefulness": "exp5/peacefulness",
        },
    ),
)


def experiment(recipe: str) -> Experiment | None:
    """The study's experiment that a recipe repeats, or None."""
    return next((one for one in EXPERIMENTS if one.recipe == recipe), None)


def curve(name: str) -> tuple[Values, Values]:
    """A published curve: episodes and values, [points] each.

    Args:
        name: as in `Experiment.curves`.

    Raises:
        KeyError: for an unknown name.
    """
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
    """How near a curve comes to a published one: Pearson's correlation, and the mean absolute difference.

    Args:
        name: of the published curve.
        values: ours, [E] from episode 0 on, smoothed and drawn alike; compared where both are.

    Raises:
        ValueError: where there are fewer than 10 points of both.
    """
    episodes, published = curve(name)
    both = episodes <= len(values) - 1
    if both.sum() < 10:
        raise ValueError(f"{len(values)} episodes hold {both.sum()} points of {name}; 10 are wanted")
    ours = np.interp(episodes[both], np.arange(len(values)), values)
    return float(np.corrcoef(ours, published[both])[0, 1]), float(np.abs(ours - published[both]).mean())
