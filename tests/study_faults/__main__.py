"""python -m tests.study_faults --kills 6: the table of `docs/study_kills.md`."""

import argparse
import sys
import tempfile
import time
from pathlib import Path

from .kills import HEAD, Driver, all_kills, wrong
from .work import drive


def main() -> None:
    """Prints a row for each kill and what differs in the end; exits with 1 if anything does."""
    parser = argparse.ArgumentParser(prog="python -m tests.study_faults", description=__doc__)
    parser.add_argument("--kills", type=int, default=6, help="their number; driver and worker take turns")
    parser.add_argument("--on", choices=("ray", "processes", "here"), default="ray", help="the executor")
    parser.add_argument("--seed", type=int, default=0, help="of their moments")
    parser.add_argument("--wait", type=float, nargs=2, default=(4.0, 20.0), help="seconds between two kills")
    parser.add_argument("--episodes", type=int, default=12, help="of each trial")
    parser.add_argument(
        "--folder", type=Path, help="of both studies, kept; a twin that is there is not run again"
    )
    parser.add_argument("--drive", type=Path, help="runs the study into this directory, and is not killed")
    given = parser.parse_args()
    if given.drive:
        sys.exit(drive(given.drive, given.on, given.episodes))
    with tempfile.TemporaryDirectory() as temporary:
        folder = given.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        code = Driver(folder / "twin", "here", given.episodes).end(7200)
        if code != 0:
            sys.exit(f"the undisturbed study ended with {code}")
        began, kills = time.monotonic(), 0
        print(HEAD)
        for kill in all_kills(
            folder / given.on,
            given.on,
            given.kills,
            seed=given.seed,
            wait_s=tuple(given.wait),
            episodes=given.episodes,
        ):
            kills += 1
            print(f"| {kills} | {kill.row}", flush=True)
        found = wrong(folder / given.on, folder / "twin")
        runs = len(list((folder / "twin" / "runs").iterdir()))
    print(
        f"\n{kills} kills in {time.monotonic() - began:.0f} s.\n{runs} runs were compared, file by file, "
        "with those of one process that nobody killed: "
        + ("; ".join(found) if found else "bit-identical, and no episode is there twice.")
    )
    sys.exit(bool(found) or kills < given.kills)


if __name__ == "__main__":
    main()
