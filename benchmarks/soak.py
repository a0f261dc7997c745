"""An hour of a training whose recording is served, beside a twin without one: what grows?

Two processes train the same experiment, `commons` with four DQN agents and two replicas, without an end.
They take turns: while one runs the other is stopped by SIGSTOP. Every few seconds of their running a row is
added to a CSV: steps, CPU seconds, memory, file descriptors, threads, bytes of the recording. The memory that
is judged is the anonymous one: what of a library's file is in memory depends on other processes.

What the served recording keeps for viewers that come later, up to `cprl.viewer.streams.SERVER_MEMORY`, is
history and no leak. Here that limit is 4 MB instead of 512 MB, so that the history is full within the
warm-up, and whatever memory grows by after it is something else.

    python benchmarks/soak.py --minutes 60 --out FOLDER
    python benchmarks/soak.py --out FOLDER --figure docs/soak.png      the table and the picture again
"""

import csv
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import psutil
import tyro
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.table import Table
from scipy.stats import theilslopes

from cprl.output import console

RECORDED, TWIN = "recorded", "twin"
TURN_S: Final = {RECORDED: 120.0, TWIN: 15.0}
"""Seconds for which each runs before the other does."""
START_S: Final = 60.0
"""Seconds for each to begin."""
SAMPLE_S: Final = 5.0
WARM_UP_SHARE: Final = 1 / 6
"""Of the running of each, before which nothing is judged: buffers fill, caches and allocators settle."""
BUFFER: Final = 5_000
HISTORY: Final = "4MB"
"""What the served recording keeps; the rows that are sent each second fill it in some minutes."""
EPISODE_STEPS: Final = 1_000
EPISODES: Final = 5_000
"""As many as the published runs have, which decides how often frames are recorded; it is not reached."""
FIELDS: Final = (
    "who",
    "ran_s",
    "steps",
    "cpu_s",
    "rss",
    "uss",
    "anonymous",
    "files",
    "threads",
    "recording",
    "journal",
)


class Steps:
    """Writes the number of environment steps of each replica into a file, in place."""

    def __init__(self, path: str) -> None:
        self.count, self.file = 0, os.open(path, os.O_RDWR | os.O_CREAT)

    def on_step(self, batch: object) -> None:
        """Counts; every 20 steps it writes."""
        self.count += 1
        if self.count % 20 == 0:
            os.pwrite(self.file, f"{self.count:012d}".encode(), 0)


def train(folder: Path, *, watch: str) -> None:
    """One of the two: trains until it is killed; writes its number of steps into the file `steps`."""
    import cprl
    from cprl import presets
    from cprl.algorithms import DQN
    from cprl.custom import Custom
    from cprl.population import Learning
    from cprl.viewer import streams

    streams.SERVER_MEMORY = HISTORY  # type: ignore[misc]
    settings = replace(presets.dqn_settings("commons"), buffer_size=BUFFER)
    game = presets.game("commons")
    experiment = cprl.Experiment(
        name="soak",
        game=replace(game, rules=replace(game.rules, episode_steps=EPISODE_STEPS)),
        agents=(Learning(DQN(settings=settings)),) * 4,
        episodes=EPISODES,
        replicas=2,
        callbacks=(Custom("soak:Steps", {"path": str(folder / "steps")}),),
    )
    cprl.run(experiment, folder / "run", watch=watch)


class Child:
    """A process that trains, stopped except in its turns."""

    def __init__(self, who: str, folder: Path) -> None:
        folder.mkdir(parents=True)
        self.who, self.folder, self.ran_s = who, folder, 0.0
        watch = "serve" if who == RECORDED else "off"
        with open(folder / "log", "wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, __file__, "--child", str(folder), "--watch", watch], stdout=log, stderr=log
            )
        self.seen = psutil.Process(self.process.pid)

    def row(self) -> dict[str, object]:
        """What is measured, in bytes and seconds."""
        memory, spent = self.seen.memory_full_info(), self.seen.cpu_times()
        run = self.folder / "run"
        steps = (self.folder / "steps").read_bytes() if (self.folder / "steps").exists() else b""
        return {
            "who": self.who,
            "ran_s": round(self.ran_s, 1),
            "steps": int(steps or 0),
            "cpu_s": round(spent.user + spent.system + spent.children_user + spent.children_system, 2),
            "rss": memory.rss,
            "uss": memory.uss,
            "anonymous": memory.rss - memory.shared,
            "files": self.seen.num_fds(),
            "threads": self.seen.num_threads(),
            "recording": sum(path.stat().st_size for path in run.glob("*.rrd")),
            "journal": sum(path.stat().st_size for path in run.glob("episodes.*")),
        }


def soak(out: Path, minutes: float) -> None:
    """Lets the two take turns until the recorded one has run so long; writes the rows."""
    out.mkdir(parents=True)
    children = [Child(RECORDED, out / RECORDED)]
    time.sleep(START_S)  # they compile one after the other
    os.kill(children[0].process.pid, signal.SIGSTOP)
    children.append(Child(TWIN, out / TWIN))
    time.sleep(START_S)
    os.kill(children[1].process.pid, signal.SIGSTOP)
    try:
        with open(out / "soak.csv", "w", newline="", encoding="utf-8") as file:
            table = csv.DictWriter(file, FIELDS)
            table.writeheader()
            while children[0].ran_s < 60 * minutes:
                for child in children:
                    turn(child, table)
                    file.flush()
    finally:
        for child in children:
            child.process.kill()
            child.process.wait()


def turn(child: Child, table: "csv.DictWriter[str]") -> None:
    """Lets one run for its turn, and adds its rows."""
    if child.process.poll() is not None:
        raise SystemExit(f"the {child.who} process ended; see {child.folder / 'log'}")
    os.kill(child.process.pid, signal.SIGCONT)
    ends = time.monotonic() + TURN_S[child.who]
    while (left := ends - time.monotonic()) > 0.01:
        began = time.monotonic()
        time.sleep(min(SAMPLE_S, left))
        child.ran_s += time.monotonic() - began
        table.writerow(child.row())
    os.kill(child.process.pid, signal.SIGSTOP)


def read(out: Path) -> dict[str, dict[str, NDArray[np.float64]]]:
    """The columns of each process."""
    with open(out / "soak.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return {
        who: {name: np.array([float(row[name]) for row in rows if row["who"] == who]) for name in FIELDS[1:]}
        for who in (RECORDED, TWIN)
    }


def growth(of: dict[str, NDArray[np.float64]], name: str) -> float:
    """Bytes per 100,000 steps of a replica after the warm-up: the median of the slopes of all pairs."""
    late = of["ran_s"] >= of["ran_s"][-1] * WARM_UP_SHARE
    return float(theilslopes(of[name][late], of["steps"][late]).slope) * 100_000


def speed(of: dict[str, NDArray[np.float64]], since: float, until: float) -> float:
    """Steps of a replica per CPU second, between two shares of its running."""
    at = np.searchsorted(of["ran_s"], np.array([since, until]) * of["ran_s"][-1])
    first, last = at.clip(0, len(of["steps"]) - 1)
    return float((of["steps"][last] - of["steps"][first]) / (of["cpu_s"][last] - of["cpu_s"][first]))


def verdict(out: Path) -> Table:
    """The table of both."""
    of = read(out)
    table = Table("", *of, "allowed", title="an hour of `commons`, 4 DQN agents, 2 replicas, in turns")
    late = {who: own["ran_s"] >= own["ran_s"][-1] * WARM_UP_SHARE for who, own in of.items()}

    def add(name: str, values: list[str], allowed: str = "") -> None:
        table.add_row(name, *values, allowed)

    add("minutes of running", [f"{own['ran_s'][-1] / 60:.0f}" for own in of.values()])
    add("steps of each replica", [f"{own['steps'][-1]:,.0f}" for own in of.values()])
    level = {who: own["anonymous"][late[who]][0] for who, own in of.items()}
    add("anonymous memory after the warm-up, MB", [f"{level[who] / 1e6:.1f}" for who in of])
    add("anonymous memory at the end, MB", [f"{own['anonymous'][-1] / 1e6:.1f}" for own in of.values()])
    grown = {who: growth(own, "anonymous") for who, own in of.items()}
    add("growth per 100,000 steps, MB", [f"{grown[who] / 1e6:+.2f}" for who in of])
    add("growth per 100,000 steps", [f"{grown[who] / level[who]:+.2%}" for who in of], "< 1 %")
    add("recording, MB", [f"{own['recording'][-1] / 1e6:.1f}" for own in of.values()])
    for name, words in (("files", "file descriptors"), ("threads", "threads")):
        spans = [own[name][late[who]] for who, own in of.items()]
        add(f"{words}, least and most", [f"{s.min():.0f}, {s.max():.0f}" for s in spans], "the same")
    first, last = [[speed(own, *span) for own in of.values()] for span in ((1 / 6, 2 / 6), (5 / 6, 1))]
    add("steps per CPU second, second sixth", [f"{value:.1f}" for value in first])
    add("steps per CPU second, last sixth", [f"{value:.1f}" for value in last])
    add("last by second", [f"{b / a:.1%}" for a, b in zip(first, last, strict=True)], ">= 95 %")
    add("recorded by twin, in the last", [f"{last[0] / last[1]:.1%}", ""])
    return table


def draw(out: Path, figure: Path) -> None:
    """Memory, file descriptors and speed over the steps."""
    of = read(out)
    drawn = Figure(figsize=(8, 8), layout="constrained")
    memory, files, rate = drawn.subplots(3, sharex=True)
    for (who, own), colour in zip(of.items(), ("#08519c", "#e6550d"), strict=True):
        steps = own["steps"] / 1000
        memory.plot(steps, own["anonymous"] / 1e6, color=colour, label=f"{who}: anonymous memory")
        files.plot(steps, own["files"], color=colour, label=f"{who}: file descriptors")
        files.plot(steps, own["threads"], color=colour, linestyle="--", label=f"{who}: threads")
        near = np.arange(12, len(steps), 12)
        speeds = (own["steps"][near] - own["steps"][near - 12]) / (
            own["cpu_s"][near] - own["cpu_s"][near - 12]
        )
        rate.plot(steps[near], speeds, color=colour, label=who)
    for axes, name in ((memory, "MB"), (files, "number"), (rate, "steps per CPU second")):
        axes.set_ylabel(name)
        axes.set_ylim(0, None)
        axes.legend(loc="lower right", fontsize=8)
    rate.set_xlabel("thousand steps of each replica")
    figure.parent.mkdir(exist_ok=True)
    drawn.savefig(figure, dpi=120)


def main(
    *,
    out: Path = Path("soak"),
    minutes: float = 60.0,
    figure: Path | None = None,
    child: Path | None = None,
    watch: str = "off",
) -> None:
    """Lets the two run, unless `out` has their rows already, and prints the table.

    Args:
        out: a folder for the rows, `soak.csv`, and the two runs.
        minutes: that the recorded one runs; all takes a third more.
        figure: the picture.
        child: for one of the two itself: its folder.
        watch: likewise: "serve" or "off".
    """
    if child is not None:
        train(child, watch=watch)
        return
    if not (out / "soak.csv").exists():
        soak(out, minutes)
    console().print(verdict(out))
    if figure is not None:
        draw(out, figure)


if __name__ == "__main__":
    tyro.cli(main)
