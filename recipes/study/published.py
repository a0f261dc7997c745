"""The published results: the table of appendix A, training curves, and the windows of their running means.

Source: M. Wiatrak, "Governing the Commons with Multi-Agent Reinforcement Learning" (2019), appendix A and the
figures of its experiments, digitised at about 830 points each.

The study does not say over how many episodes its running means are; the curves alone do. A running mean
over w episodes has no power at the frequencies k / w: whole waves fit into the window, their mean is 0.
Its increments are those of the episodes, w apart, so their spectrum is proportional to sin(pi f w)**2 if the
episodes are white noise about a slow course. The window whose spectrum fits best, by the likelihood of
P. Whittle ("Estimation and information in stationary time series", 1953), is the estimate.
"""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cprl.commons.published import Board

Values = NDArray[np.float64]

PHASED_RECIPE: Final = "commons"
"""Our recipe of experiment 5, the only one whose phases the study draws."""


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
    published curves have theirs, see `estimate_window`."""
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
    return next((one for one in EXPERIMENTS if one.recipe == recipe), None)


def curve(name: str) -> tuple[Values, Values]:
    """A published curve: its episodes and its values, float64 [points] each.

    Args:
        name: as in `PublishedExperiment.curves`.
    """
    return _curves()[name]


@cache
def _curves() -> dict[str, tuple[Values, Values]]:
    points: dict[str, list[tuple[float, float]]] = {}
    with (Path(__file__).parent / "published_curves.csv").open(encoding="utf-8") as file:
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
        ValueError: If the published curve has fewer than 10 points in these episodes.
    """
    episodes, published = curve(name)
    both = episodes <= len(values) - 1
    if both.sum() < 10:
        raise ValueError(f"{len(values)} episodes have {both.sum()} points of {name}; allowed: at least 10")
    ours = np.interp(episodes[both], np.arange(len(values)), values)
    return float(np.corrcoef(ours, published[both])[0, 1]), float(np.abs(ours - published[both]).mean())


WINDOWS: Final = tuple(range(15, 251, 5))
"""The candidates, in episodes."""
SLOWEST: Final = 0.002
FASTEST: Final = 0.06
"""The frequencies that are looked at, in waves per episode: slower ones are the course of learning, faster
ones are lost where a figure has a point for every seventh episode."""
NOISE: Final = 0.05
"""The power that is left at a null, as a share of the largest: of reading points off a figure."""
INDEPENDENT: Final = 1 / (1 + 2 * (4 / 9 + 1 / 36))
"""The share of frequencies that count as independent. Under a Hann taper the powers of neighbouring ones are
correlated by (2 / 3)**2, and those of the next but one by (1 / 6)**2."""


@dataclass(frozen=True, kw_only=True)
class WindowEstimate:
    """The window of a running mean, and how clearly it differs from others."""

    window_episodes: int
    """The candidate with the largest likelihood."""
    nats: Mapping[int, float]
    """By how much the logarithm of each candidate's likelihood falls short of the largest, at least 0."""

    @property
    def better_by_nats(self) -> float:
        """The advantage over the next best candidate."""
        return min(
            (lost for window, lost in self.nats.items() if window != self.window_episodes), default=0.0
        )


def estimate_window(episodes: Values, values: Values, *, windows: Sequence[int] = WINDOWS) -> WindowEstimate:
    """Estimates the window of a running mean.

    Args:
        episodes: the episode of each point, float [P], ascending; points may be unevenly spaced.
        values: the running mean at each point, float [P]. Where in a window it is drawn does not matter.
        windows: the candidates in episodes, at least 2 each; 15, 20 .. 250 by default.

    Raises:
        ValueError: if the episodes span fewer than four of the longest candidates.
    """
    if episodes[-1] - episodes[0] < 4 * max(windows):
        raise ValueError(
            f"episodes are {episodes[0]:g} to {episodes[-1]:g}; allowed: at least {4 * max(windows)}, four "
            "of the longest candidates"
        )
    power, frequency = _spectrum(episodes, values)
    costs = {window: _cost(power, frequency, window) for window in windows}
    best = min(costs, key=lambda window: costs[window])
    return WindowEstimate(
        window_episodes=best, nats={window: cost - costs[best] for window, cost in costs.items()}
    )


def _spectrum(at: Values, curve: Values) -> tuple[Values, Values]:
    """The power of the curve's increments between episodes, and its frequencies, those looked at."""
    every = np.arange(np.ceil(at[0]), at[-1])
    steps = np.diff(np.interp(every, at, curve))
    power = np.abs(np.fft.rfft(steps * np.hanning(len(steps)))) ** 2
    frequency = np.asarray(np.fft.rfftfreq(len(steps)), np.float64)
    seen = (frequency > SLOWEST) & (frequency < FASTEST)
    return power[seen], frequency[seen]


def _cost(power: Values, frequency: Values, window: int) -> float:
    """Minus the logarithm of Whittle's likelihood at the best scale of the spectrum, up to a constant."""
    expected = np.sin(np.pi * frequency * window) ** 2 + NOISE
    with np.errstate(divide="ignore"):
        cost = np.log((power / expected).mean()) + np.log(expected).mean()
    return float(INDEPENDENT * len(power) * cost)
