"""The course of a training in four sentences: how much was harvested at the peak and at the end, how long
boards lasted, and what random play gets."""

from dataclasses import dataclass
from math import nan, sqrt
from pathlib import Path
from typing import Final

from cprl.runs.curves import as_curves, curves_of, running_mean
from cprl.runs.episodes import read_table

PEAK_EPISODES: Final = 10
"""Episodes of the mean whose highest value is the peak."""
LAST_EPISODES: Final = 30
"""Episodes at the end that are compared with the peak and with random play."""
BELOW_RANDOM, PEAK_OVER_RANDOM, SURVIVAL_SHARE = 0.95, 1.5, 0.7
"""A tragedy, here: the last episodes yield at most this share of random play, the peak was at least this many
times random play, and boards last at most this share of the turns that they could."""


@dataclass(frozen=True, kw_only=True)
class Course:
    """The course of a training; returns and steps are means over episodes and replicas."""

    replicas: int
    episodes: int
    longest_steps: int
    """The turns of the longest episode."""
    first_return: float
    """Of the first `PEAK_EPISODES` episodes, in apples, all agents together."""
    peak_return: float
    peak_episode: int
    """The first of the `PEAK_EPISODES` episodes with the highest mean."""
    last_return: float
    """Of the last `LAST_EPISODES` episodes."""
    last_survival_steps: float
    random_return: float
    random_error: float
    """The standard error of `random_return`."""

    @property
    def is_tragedy(self) -> bool:
        """Whether agents who learn end worse off than agents who do not, after they had been better off."""
        return (
            self.random_return > 0
            and self.last_return <= BELOW_RANDOM * self.random_return
            and self.peak_return >= PEAK_OVER_RANDOM * self.random_return
            and self.last_survival_steps <= SURVIVAL_SHARE * self.longest_steps
        )


def course_of(run: Path) -> Course:
    """The course of a finished run of a game that reports its harvest and how long its boards last.

    Raises:
        FileNotFoundError: if the run has no evaluation.
    """
    curves = curves_of(run)
    lacking = sorted({"collective_return", "survival_steps"} - set(curves))
    if lacking:
        raise ValueError(f"the episodes of {run} lack {', '.join(lacking)}; allowed: games that report them")
    returns, survival = curves["collective_return"], curves["survival_steps"]
    tens = running_mean(returns.mean(0), PEAK_EPISODES)
    random = as_curves(read_table(run / "evaluation" / "random.parquet"))["collective_return"]
    return Course(
        replicas=len(returns),
        episodes=returns.shape[1],
        longest_steps=int(survival.max()),
        first_return=float(tens[0]),
        peak_return=float(tens.max()),
        peak_episode=int(tens.argmax()),
        last_return=float(returns[:, -LAST_EPISODES:].mean()),
        last_survival_steps=float(survival[:, -LAST_EPISODES:].mean()),
        random_return=float(random.mean()),
        random_error=float(random.std(ddof=1) / sqrt(random.size)) if random.size > 1 else nan,
    )


def in_sentences(course: Course) -> str:
    """Four sentences: the peak, what came after it, how long boards last, and what that means."""
    last = min(LAST_EPISODES, course.episodes)
    if course.is_tragedy:
        meaning = (
            "Each agent learned to take what pays now, and all of them, trained, end worse off than agents "
            "who never learned: the tragedy of the commons."
        )
    elif course.last_return > course.random_return:
        meaning = "They end better off than agents who never learned: no tragedy so far."
    else:
        meaning = "They end no better off than agents who never learned."
    return " ".join(
        [
            f"The agents began at {course.first_return:.0f} apples an episode, all together, and reached "
            f"{course.peak_return:.0f} around episode {course.peak_episode + PEAK_EPISODES // 2}, "
            f"{_peak_beside_random(course)}.",
            f"In the last {last} episodes they got {course.last_return:.0f}"
            f"{_last_beside_peak_and_random(course)}.",
            f"Boards that can last {course.longest_steps} steps now last {course.last_survival_steps:.0f}.",
            meaning,
        ]
    )


def _peak_beside_random(course: Course) -> str:
    """Nothing is a number of times what random play gets where that gets nothing."""
    if not course.random_return:
        return "where random play gets none"
    over = course.peak_return / course.random_return
    return f"{over:.1f} times the {course.random_return:.0f} ± {course.random_error:.0f} of random play"


def _last_beside_peak_and_random(course: Course) -> str:
    """Shares of the peak and of random play; of nothing there are none."""
    parts = []
    if course.peak_return:
        parts.append(f"{abs(course.last_return / course.peak_return - 1):.0%} below that peak")
    if course.random_return:
        change = course.last_return / course.random_return - 1
        parts.append(f"{abs(change):.0%} {'less' if change < 0 else 'more'} than random play gets")
    return f", {' and '.join(parts)}" if parts else ""
