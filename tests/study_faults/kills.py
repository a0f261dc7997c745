"""Runs a study, kills its driver or a worker at random moments, starts it again, and compares the outcome."""

import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import psutil
import pyarrow.parquet as pq

from cprl.studies.status import Status
from cprl.studies.trials import state_of, trials_of

from ..faults.driver import differences, progress, still_alive
from .work import study

ROOT: Final = Path(__file__).parents[2]
HEAD: Final = (
    "| kill | after the start or the last kill | of | trials finished | trials that it hit "
    "| newest checkpoint, step | rows | workers gone after |\n|---:|---:|---|---:|---|---:|---:|---:|"
)


@dataclass(frozen=True, kw_only=True)
class Kill:
    """A SIGKILL, and what it found."""

    after_s: float
    """Since the one before, or the start."""
    victim: str
    """"driver" or "worker"."""
    finished: int
    """Trials that were."""
    hit: tuple[tuple[str, int, int], ...]
    """Trials that were running, each with the step of its newest checkpoint and the rows of its table."""
    gone_s: float
    """Until the workers that ran these trials had ended."""

    @property
    def row(self) -> str:
        """Its cells in the table of the docs."""
        cells = ["<br>".join(str(own[place]) for own in self.hit) or "none" for place in range(3)]
        where = f"{self.after_s:.1f} s | {self.victim} | {self.finished} | {' | '.join(cells)}"
        return f"{where} | {self.gone_s:.1f} s |"


class Driver:
    """A process that runs the study."""

    def __init__(self, out: Path, on: str, episodes: int) -> None:
        where = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT / "src"), str(ROOT)])}
        argv = [sys.executable, "-m", "tests.study_faults", "--drive", str(out), "--on", on]
        argv += ["--episodes", str(episodes)]
        self.out = out
        self.names = [trial.name for trial in trials_of(study(episodes))]
        with open(out.with_suffix(".out"), "ab") as said:
            self.process = subprocess.Popen(argv, cwd=ROOT, env=where, stdout=said, stderr=said)

    @property
    def is_alive(self) -> bool:
        """Whether it runs."""
        return self.process.poll() is None

    def family(self) -> list[psutil.Process]:
        """The processes that it has started, and those that these have."""
        with suppress(psutil.NoSuchProcess):
            return psutil.Process(self.process.pid).children(recursive=True)
        return []

    def end(self, deadline_s: float) -> int:
        """Waits until it has ended; its exit code."""
        return self.process.wait(deadline_s)


def running(driver: Driver) -> dict[str, dict[str, Any]]:
    """The trials that workers of this driver run, each with its status."""
    pids = {own.pid for own in driver.family()}
    found = {name: Status(driver.out / "status", name).read() for name in driver.names}
    return {
        name: own
        for name, own in found.items()
        if own.get("pid") in pids and not is_finished(driver.out, name)
    }


def is_training(driver: Driver, begun: dict[tuple[str, int], int]) -> bool:
    """Whether a trial has made more than ten steps since its process was first seen; before that it compiles.

    Args:
        driver: runs the study.
        begun: the steps with which each trial and process was first seen; changed.
    """
    own = running(driver)
    return any(
        said["steps"] > begun.setdefault((name, said["pid"]), said["steps"]) + 10
        for name, said in own.items()
    )


def is_finished(out: Path, name: str) -> bool:
    """Whether a trial is."""
    return state_of(out / "runs" / name) == "finished"


def killed(driver: Driver, victim: str, chance: random.Random, since: float) -> Kill | None:
    """Kills the driver, or one of the workers that run a trial; None if there was nothing to kill."""
    workers, family = running(driver), driver.family()
    if not driver.is_alive or not workers:
        return None
    hit, began = sorted(workers), time.monotonic()
    if victim == "driver":
        driver.process.kill()
        driver.process.wait()
    else:
        hit = [chance.choice(hit)]
        os.kill(workers[hit[0]]["pid"], signal.SIGKILL)
    died = {workers[name]["pid"] for name in hit}
    still_alive([own for own in family if own.pid in died], 60)
    return Kill(
        after_s=began - since,
        victim=victim,
        finished=sum(is_finished(driver.out, name) for name in driver.names),
        hit=tuple((name, *progress(driver.out / "runs" / name)) for name in hit),
        gone_s=time.monotonic() - began,
    )


def all_kills(
    out: Path, on: str, kills: int, *, seed: int, wait_s: tuple[float, float], episodes: int
) -> Iterator[Kill]:
    """Kills in turn the driver and a worker, and ends the study; each a random time of `wait_s` after a trial
    has begun that was not running before, and of two kills in three after its first steps."""
    chance = random.Random(seed)
    driver, since, done = Driver(out, on, episodes), time.monotonic(), 0
    begun: dict[tuple[str, int], int] = {}
    while done < kills and driver.is_alive:
        if not (running(driver) if done % 3 == 2 else is_training(driver, begun)):
            time.sleep(0.1)
            continue
        until = time.monotonic() + chance.uniform(*wait_s)
        while time.monotonic() < until and driver.is_alive:
            time.sleep(0.05)
        victim = ("driver", "worker")[done % 2]
        if (kill := killed(driver, victim, chance, since)) is None:
            continue
        yield kill
        done, since, begun = done + 1, time.monotonic(), {}
        if victim == "driver":
            driver = Driver(out, on, episodes)
    if (code := driver.end(3600)) != 0:
        raise RuntimeError(f"the study ended with {code}: {out.with_suffix('.out').read_text()[-2000:]}")


def wrong(out: Path, twin: Path) -> list[str]:
    """What is not the same in two studies, bit for bit; and episodes that are in a table twice."""
    names = [own.name for own in sorted((twin / "runs").iterdir())]
    found = [
        f"{name}: not in the study" for name in {own.name for own in (out / "runs").iterdir()} ^ set(names)
    ]
    for name in names:
        found += [f"{name}: {what}" for what in differences(out / "runs" / name, twin / "runs" / name)]
        rows = pq.read_table(
            out / "runs" / name / "episodes.parquet", columns=["replica", "episode", "agent"]
        )
        twice = [row for row, times in Counter(map(tuple, _rows(rows.to_pylist()))).items() if times > 1]
        found += [f"{name}: {row} is there twice" for row in twice]
    return found


def _rows(table: list[dict[str, int]]) -> Iterator[tuple[int, ...]]:
    return (tuple(row.values()) for row in table)
