"""Time and memory of `cprl evaluate` by two checkouts, in pairs.

    python benchmarks/evaluating.py ../main . --run docs/results/commons --pairs 5

Each pair runs the command once by each checkout, one after the other, the first of them in turn, so that a
machine that slows down slows both. The ratios of pairs are what counts. `--words` are another command, e.g.
`--words table docs/results/studies/experiment_5`.
"""

import argparse
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path


def measured(checkout: Path, arguments: list[str]) -> tuple[float, float]:
    """Return the seconds and the peak of the memory in MB of a command by the code of a checkout."""
    environment = {**os.environ, "PYTHONPATH": str(checkout.resolve() / "src")}
    code = (
        "import resource, runpy, sys; sys.argv = ['cprl', *sys.argv[1:]]\n"
        "try: runpy.run_module('cprl', run_name='__main__')\n"
        "finally: print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, file=sys.stderr)"
    )
    began = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], env=environment, capture_output=True, text=True, check=True
    )
    return time.perf_counter() - began, float(done.stderr.split()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    parser.add_argument("--run", default="docs/results/commons")
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument(
        "--words", nargs=argparse.REMAINDER, help="another command, last; by default evaluate RUN"
    )
    options = parser.parse_args()
    arguments = options.words or ["evaluate", options.run]
    checkouts = {"before": options.before, "after": options.after}
    for checkout in checkouts.values():  # compile and fill the caches
        measured(checkout, arguments)
    ratios = []
    for pair in range(options.pairs):
        names = list(checkouts) if pair % 2 == 0 else list(reversed(checkouts))
        costs = {name: measured(checkouts[name], arguments) for name in names}
        before_s, before_mb = costs["before"]
        after_s, after_mb = costs["after"]
        ratios.append((after_s / before_s, after_mb / before_mb))
        print(
            f"{before_s:6.2f} s -> {after_s:6.2f} s   {before_mb:6.0f} MB -> {after_mb:6.0f} MB   "
            f"ratios {ratios[-1][0]:.3f}, {ratios[-1][1]:.3f}",
            flush=True,
        )
    times, memory = zip(*ratios, strict=True)
    print(
        f"{' '.join(arguments)}: median of {len(ratios)} pairs, after / before: "
        f"time {statistics.median(times):.3f}, memory {statistics.median(memory):.3f}"
    )


if __name__ == "__main__":
    main()
