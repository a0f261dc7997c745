"""The short schedule of `make run` for several seeds, as a Markdown table.

    for seed in 1 2 3; do python recipes/tragedy.py --seed $seed --watch off --out runs/tragedy-$seed; done
    python docs/tragedy_seeds.py runs/tragedy-*

Intervals are those of the mean over replicas, 95 %, by Student's t.
"""

import sys
from pathlib import Path

from cprl.measuring.statistics import Estimate, estimate
from cprl.measuring.windows import running_mean
from cprl.runs.curves import as_curves, curves_of
from cprl.runs.episodes import read_table
from cprl.terminal.course import course_of
from cprl.training.stored import load

HEADING = (
    "| seed | replicas | peak of 10 episodes, apples | its episode | last 30 episodes, apples "
    "| beside random play | survival in the last 30, steps | tragedy |"
)


def main(runs: list[Path]) -> None:
    """Print a row for each run."""
    print(HEADING)
    print("|" + "---:|" * HEADING.count(" | ") + "---|")
    for run in runs:
        stored = load(run)
        at_end = curves_of(run, last=30)
        returns = curves_of(run)["collective_return"]
        lengths = at_end["survival_steps"].mean(1)
        first = int(running_mean(returns.mean(0), 10).argmax())
        last = estimate(at_end["collective_return"].mean(1))
        random = as_curves(read_table(run / "evaluation" / "random.parquet"))["collective_return"]
        error = random.std(ddof=1) / random.size**0.5
        cells = [
            stored.experiment.seed,
            len(returns),
            _text_of(estimate(returns[:, first : first + 10].mean(1))),
            first,
            _text_of(last),
            f"{last.value / random.mean() - 1:+.0%} of {random.mean():.0f} ± {error:.1f}",
            _text_of(estimate(lengths)),
            "yes" if "the tragedy of the commons" in course_of(run, stored.specs) else "no",
        ]
        print("| " + " | ".join(map(str, cells)) + " |")


def _text_of(found: Estimate) -> str:
    return f"{found.value:.0f} [{found.low:.0f}, {found.high:.0f}]"


if __name__ == "__main__":
    main([Path(name) for name in sys.argv[1:]])
