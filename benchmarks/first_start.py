"""What the first start of a game costs, by two checkouts: processor time of a process, user and system, with
those it starts.

    python benchmarks/first_start.py ../main .

Each game runs in a new process with an empty CPRL_CACHE, and in a second one with what the first kept there:
one world is made, begins an episode, plays a turn, and loads its state.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final

GAMES: Final = {
    "commons, published": 'presets.game("commons")',
    "commons, as run": 'presets.game("commons", variant="as_run")',
    "commons, with a quota": 'replace(presets.game("commons"), institutions=(Quota(),))',
    "cleanup": 'presets.game("ssd/cleanup-v1")',
}
START: Final = """
from dataclasses import replace
import numpy as np
from cprl import presets
from cprl.commons.batch import Batch
from cprl.institutions import Quota
batch = Batch({game}, 1)
output = batch.begin(batch.new_output())
batch.play(np.zeros((1, batch.game.agents), np.int64), output)
batch.load(batch.state(), output)
"""


def start_s(checkout: Path, game: str, cache: str) -> float:
    """Return the processor time in seconds of a start by the code of a checkout."""
    environment = {**os.environ, "PYTHONPATH": str(checkout.resolve() / "src"), "CPRL_CACHE": cache}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-c", START.format(game=game)], env=environment, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    options = parser.parse_args()
    for name, game in GAMES.items():
        for checkout in (options.before, options.after):
            with tempfile.TemporaryDirectory() as cache:
                first_s = start_s(checkout, game, cache)
                second_s = start_s(checkout, game, cache)
            print(f"{name}, {checkout}: {first_s:6.1f} s, then {second_s:4.1f} s", flush=True)


if __name__ == "__main__":
    main()
