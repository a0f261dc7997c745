"""Do the study's five experiments come out again? All are run, and reported beside the published figures.

    python recipes/study/reproduce.py --runs ~/cprl-runs --results docs/results

Every run is resumable: started again with the same --runs, this resumes where it was stopped, and what is
finished is not run again; a run of another recipe or with other flags is refused. As soon as a run is
finished its results are kept in --results; in the end the report is written there. About an hour for each
single board and two for each `commons`, on one core.
"""

import os
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Event
from typing import Literal

import tyro
from report import write_report

from cprl.commands.recipe_command import exit_with_message
from cprl.runs.export import export_results
from cprl.system.output import say
from cprl.system.process import prepare_process
from cprl.system.shipped import recipe_named

AS_RUN = ("--variant", "as_run")
DECAY_500K = ("--epsilon-decay-steps", "500000")
TARGETS_10 = ("--target-every-episodes", "10")
EXPERIMENTS = {
    "commons": ("commons", *AS_RUN),
    "single_basic": ("single_basic", *AS_RUN),
    "single_complex": ("single_complex", *AS_RUN),
    "two_against_random": ("two_against_random", *AS_RUN),
    "two_complex": ("two_complex", *AS_RUN),
    "commons_decay_500k": ("commons", *AS_RUN, *DECAY_500K),
    "commons_published": ("commons", "--variant", "published"),
    "commons_targets_10": ("commons", *AS_RUN, *TARGETS_10, "--episodes", "1600"),
    "commons_targets_10_decay_500k": ("commons", *AS_RUN, *TARGETS_10, *DECAY_500K, "--episodes", "2000"),
    "commons_published_decay_500k": ("commons", "--variant", "published", *DECAY_500K),
}
"""Recipe and arguments by the name of the run, the most telling first."""


def main(
    *,
    runs: Path,
    results: Path = Path("results"),
    only: tuple[str, ...] = tuple(EXPERIMENTS),
    replicas: int = 8,
    episodes: int | None = None,
    processes: int | None = None,
    engine: Literal["compiled", "eager"] = "compiled",
) -> Path:
    """Run experiments, keep their results, and return the report.

    Args:
        runs: where run directories are made, and resumed; some gigabytes while they train.
        results: where results and the report are kept.
        only: which, by name.
        replicas: of each.
        episodes: of each; by default the recipe's, as the study shows.
        processes: at once; by default one for each core.
        engine: how updates are computed; "compiled" requires a C++ compiler.
    """
    for name in only:
        if name not in EXPERIMENTS:
            raise ValueError(f"there is no experiment {name!r}; allowed: {', '.join(EXPERIMENTS)}")
    common = ["--replicas", str(replicas), "--engine", engine]
    if episodes is not None:
        common += ["--episodes", str(episodes)]
    run_all(only, common, runs=runs, results=results, processes=processes)
    prepare_process(0)
    return write_report([results / name for name in only], results)


def run_all(
    names: Sequence[str], common: Sequence[str], *, runs: Path, results: Path, processes: int | None
) -> None:
    """Run experiments, some at once; after Ctrl-C or once one has failed, those that wait are not begun."""
    is_over = Event()

    def run_next(name: str) -> None:
        if is_over.is_set():
            return
        try:
            run(name, common, runs=runs, results=results)
        except BaseException:
            is_over.set()
            raise

    with ThreadPoolExecutor(processes or os.cpu_count()) as pool:
        try:
            for ended in [pool.submit(run_next, name) for name in names]:
                ended.result()
        finally:
            is_over.set()


def run(name: str, common: Sequence[str], *, runs: Path, results: Path) -> None:
    """Run an experiment in a process of its own, or resume it, and keep its results.

    What is finished is resumed too: its recipe refuses a run of another one, and then has nothing to do.

    Raises:
        ChildProcessError: if it fails or is stopped; ends with the last line of its log.
    """
    recipe, *arguments = EXPERIMENTS[name]
    directory = runs / name
    log = runs / f"{name}.log"
    runs.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, str(recipe_named(recipe).path), *arguments, *common, "--out", str(directory)]
    if (directory / "recipe.json").exists():
        command.append("--resume")
    say(f"{name}: see {log}")
    with open(log, "a") as output:
        done = subprocess.run(command, stdout=output, stderr=subprocess.STDOUT, check=False)
    if done.returncode or not (directory / "report.json").exists():
        *_, last = ["", *log.read_text(encoding="utf-8", errors="replace").splitlines()]
        raise ChildProcessError(f"{name} ended with {done.returncode} and is not finished; see {log}: {last}")
    say(f"{name}: {export_results(directory, results / name)}")


if __name__ == "__main__":
    with exit_with_message("reproduce.py"):
        say(tyro.cli(main))
