"""What a newcomer waits for: seconds from the start of `make run`'s command to each thing that can be seen.

    python benchmarks/first_minute.py               with the caches of compiled code as they are
    python benchmarks/first_minute.py --cold        with empty ones
    python benchmarks/first_minute.py --pictures P  pictures of Rerun's viewer at 10, 60, 120 s and the end

The first board is there when a picture of Rerun's viewer has apples in it; the viewer is opened at the
address and closed then, and its own start counts. What else is served is written to a file by `rerun --save`
and looked at every half second, so times are up to half a second and its delay too long. Pictures are drawn
without a graphics card and slow the training down: take times from a run without --pictures.
"""

import os
import re
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from threading import Thread

import numpy as np
import tyro
from PIL import Image
from rerun.chunk import RrdReader

sys.path.insert(0, str(Path(__file__).parents[1] / "docs"))
from viewers import VIEWER, native_viewer

from cprl.commons.cells import APPLE
from cprl.pictures.colours import PALETTE

IMPORTS = "import cprl; cprl.recipe_main; import cprl.training.running"
ADDRESS = re.compile(r"rerun\+http://127\.0\.0\.1:\d+/proxy")
COMMAND = ("recipes/tragedy.py", "--watch", "serve", "--linger")
LATER_S = (10.0, 60.0, 120.0)
BOARD_PIXELS = 500
"""The pixels of apples, in a viewer's window of 640 x 400, on a board that is drawn; the plots have fewer."""


class Run:
    """The command, its lines with the seconds at which they came, and the entities that it has served."""

    def __init__(self, command: tuple[str, ...], environment: dict[str, str], folder: Path) -> None:
        self.folder = folder
        self.began = time.perf_counter()
        self.lines: list[tuple[float, str]] = []
        self.entities: dict[str, float] = {}
        self.addresses: list[str] = []
        self.board: float | None = None
        self.process = subprocess.Popen(
            [sys.executable, "-u", *command, "--out", str(folder / "run")],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=environment,
        )
        self._savers: list[subprocess.Popen[bytes]] = []
        Thread(target=self._read, daemon=True).start()

    @property
    def age_s(self) -> float:
        return time.perf_counter() - self.began

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.append((self.age_s, line.rstrip()))
            print(f"{self.age_s:7.1f} s  {line.rstrip()}", flush=True)
            if "native" in line:
                self._save(list(dict.fromkeys(ADDRESS.findall(line))))

    def _save(self, addresses: list[str]) -> None:
        for number, address in enumerate(addresses):
            target = self.folder / f"served-{number}.rrd"
            command = [str(VIEWER), address, "--port", "auto", "--save", str(target)]
            self._savers.append(
                subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            )
        self.addresses = addresses
        Thread(target=self._look_at_the_board, daemon=True).start()

    def _look_at_the_board(self) -> None:
        """Note when a viewer shows apples."""
        with native_viewer(connect_to=self.addresses, size=(640, 400)) as client:
            while self.board is None and self.process.poll() is None:
                pixels = np.asarray(Image.open(BytesIO(client.take_screenshot())).convert("RGB"), np.int32)
                if (abs(pixels - PALETTE[APPLE]).max(-1) <= 4).sum() > BOARD_PIXELS:
                    self.board = self.age_s

    def look(self) -> None:
        """Note which columns have come, as "/entity Component:field"."""
        for path in self.folder.glob("served-*.rrd"):
            with warnings.catch_warnings(), suppress(Exception):  # of the last chunk, half of it may be there
                warnings.simplefilter("ignore")  # the file has no footer yet
                for chunk in RrdReader(path).stream():
                    for column in chunk.to_record_batch().schema.names:
                        self.entities.setdefault(f"{chunk.entity_path} {column}", self.age_s)

    def line(self, what: str) -> float | None:
        return next((at for at, text in self.lines if what in text), None)

    def column(self, *names: str) -> float | None:
        return min((at for name, at in self.entities.items() if name in names), default=None)

    def end(self) -> None:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
            self.process.wait(60)
        for saver in self._savers:
            saver.kill()
            saver.wait()


def main(*, cold: bool = False, pictures: Path | None = None, size: tuple[int, int] = (1600, 1000)) -> None:
    """Run the command until it says that it is still served, and print a table.

    Args:
        cold: whether the caches of compiled code are empty.
        pictures: a folder for pictures of the viewer.
        size: of the viewer's window, in pixels.
    """
    with tempfile.TemporaryDirectory() as folder:
        environment = dict(os.environ)
        environment.pop("TORCHINDUCTOR_CACHE_DIR", None)
        if cold:
            environment["CPRL_CACHE"] = str(Path(folder) / "cache")
        began = time.perf_counter()
        subprocess.run([sys.executable, "-c", IMPORTS], check=True, env=environment)
        imports_s = time.perf_counter() - began
        run = Run(COMMAND, environment, Path(folder))
        try:
            wait(run, lambda: bool(run.addresses))
            if pictures is None:
                wait(run, lambda: run.line("stays served") is not None)
            else:
                take_pictures(run, pictures, size)
            run.look()
        finally:
            run.end()
    print(f"\n| seconds from the start, {'empty' if cold else 'warm'} caches | |\n|---|---:|")
    for what, at in (
        ("imports alone, in a process of their own", imports_s),
        ("address", run.line("Watch live")),
        ("first board, in a picture of the viewer", run.board),
        ("first line about compiling", run.line("compiling")),
        ("first point of a curve", run.column("/social/collective_return Scalars:scalars")),
        ("end of training and evaluation: the table", run.line("collective return")),
        ("all said, still served", run.line("stays served")),
    ):
        print(f"| {what} | {'never' if at is None else f'{at:.1f}'} |")


def wait(run: Run, is_there: Callable[[], bool]) -> None:
    while not is_there() and run.process.poll() is None:
        time.sleep(0.5)
        run.look()


def take_pictures(run: Run, folder: Path, size: tuple[int, int]) -> None:
    """Take pictures of the viewer at `LATER_S`, and when the run has ended."""
    folder.mkdir(parents=True, exist_ok=True)
    with native_viewer(connect_to=run.addresses, size=size) as client:
        for moment in LATER_S:
            wait(run, lambda moment=moment: run.age_s >= moment)
            (folder / f"{size[0]}-{moment:.0f}s.png").write_bytes(client.take_screenshot())
        wait(run, lambda: run.line("stays served") is not None)
        time.sleep(5)
        (folder / f"{size[0]}-end.png").write_bytes(client.take_screenshot())


if __name__ == "__main__":
    tyro.cli(main)
