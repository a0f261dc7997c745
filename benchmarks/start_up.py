"""What an answer of the command line costs: processor time of a process, user and system, the median of nine.

make bench
"""

import resource
import sys
from statistics import median
from subprocess import DEVNULL, run
from typing import Final

import tyro

MOST_S: Final = 0.3
"""The seconds that are allowed where the answer needs nothing of a run."""
AT_ONCE: Final = (
    *(("-m", "cprl", "--version"), ("-m", "cprl", "--help"), ("-m", "cprl", "recipe")),
    *(("-m", "cprl", "run", "comons"), ("-m", "cprl", "run", "commons", "--epsiodes", "3")),
    *(("-m", "cprl", "evalute"), ("-m", "cprl", "evaluate", "runs/1", "--episods", "3")),
    *(("-m", "cprl", "film", "--help"), ("-c", "import cprl")),
)
OTHERS: Final = (
    *(("-m", "cprl", "run", "commons", "--help"), ("-c", "import torchrl.envs")),
    ("-c", "import cprl, torchrl.envs"),
)
"""The flags of a recipe are made of its experiment, which needs torch."""


def median_s(arguments: tuple[str, ...], times: int) -> float:
    """Return the processor time of `python ARGUMENTS`, in seconds."""
    seconds = []
    for _ in range(times):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        run([sys.executable, *arguments], stdout=DEVNULL, stderr=DEVNULL)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        seconds.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return median(seconds)


def main(times: int = 9) -> None:
    """Print the time of each, and end with exit code 1 where an answer takes longer than is allowed.

    Args:
        times: processes of each.
    """
    seconds = {command: median_s(command, times) for command in (*AT_ONCE, *OTHERS)}
    for command, value in seconds.items():
        print(f"{value:6.2f} s  python {' '.join(command)}")
    sys.exit(int(max(seconds[command] for command in AT_ONCE) > MOST_S))


if __name__ == "__main__":
    tyro.cli(main)
