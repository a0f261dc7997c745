"""The short schedule of `make run` for several seeds, as a Markdown table.

    for seed in 1 2 3; do python recipes/tragedy.py --seed $seed --watch off --out runs/tragedy-$seed; done
    python docs/tragedy_seeds.py runs/tragedy-*

Intervals are those of the mean over replicas, 95 %, by Student's t.
"""

import sys
from pathlib import Path

from cprl.measuring.statistics import Estimate, estimate
from cprl.runs.curves import curves_of
from cprl.terminal.course import LAST_EPISODES, PEAK_EPISODES, course_of
from cprl.training.agents import load

HEADING = (
    "| seed | replicas | peak of 10 episodes, apples | its episode | last 30 episodes, apples "
    "| beside random play | survival in the last 30, steps | tragedy |"
)


def main(runs: list[Path]) -> None:
    """Prints a row for each run."""
    print(HEADING)
    print("|" + "---:|" * HEADING.count(" | ") + "---|")
    for run in runs:
        course, curves = course_of(run), curves_of(run)
        peak = curves["collective_return"][:, course.peak_episode : course.peak_episode + PEAK_EPISODES]
        last = curves["collective_return"][:, -LAST_EPISODES:].mean(1)
        lengths = curves["survival_steps"][:, -LAST_EPISODES:].mean(1)
        change = course.last_return / course.random_return - 1
        cells = [
            load(run).experiment.seed,
            course.replicas,
            _told(estimate(peak.mean(1))),
            course.peak_episode,
            _told(estimate(last)),
            f"{change:+.0%} of {course.random_return:.0f} ± {course.random_error:.1f}",
            _told(estimate(lengths)),
            "yes" if course.is_tragedy else "no",
        ]
        print("| " + " | ".join(map(str, cells)) + " |")


def _told(found: Estimate) -> str:
    return f"{found.value:.0f} [{found.low:.0f}, {found.high:.0f}]"


if __name__ == "__main__":
    main([Path(name) for name in sys.argv[1:]])
