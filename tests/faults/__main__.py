"""python -m tests.faults --kills 100: the table of kills in `docs/reliability.md`."""

import argparse
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from .kills import HEAD, all_kills


def main() -> None:
    """Prints a row for each kill, and how many ended how; exits with 1 if any run was not the same."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults", description=__doc__)
    parser.add_argument("--kills", type=int, default=100, help="their number")
    parser.add_argument("--seed", type=int, default=0, help="of their moments")
    given = parser.parse_args()
    began, done = time.monotonic(), []
    with tempfile.TemporaryDirectory() as folder:
        print(HEAD)
        for number, kill in enumerate(all_kills(Path(folder), given.kills, seed=given.seed), 1):
            done.append(kill)
            print(f"| {number} | {kill.row}", flush=True)
    stages = ", ".join(f"{stage} {number}" for stage, number in Counter(kill.stage for kill in done).items())
    wrong = sum(bool(kill.outcome) for kill in done)
    print(
        f"\n{len(done)} kills ({stages}) in {time.monotonic() - began:.0f} s; {wrong} of a run that was not"
    )
    print("bit-identical in the end.")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
