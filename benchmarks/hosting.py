"""A hosted game under load: the time from a key to the board that shows it, late turns, and processor time.

30 simulated people and two at real Chromium browsers play in groups of eight, with a sustainable agent in
each, at 8 turns a second. Beside them a hundred strangers hold connections open on which they say nothing;
the server closes each after five seconds, and it comes again. Server, people, browsers and strangers share
the cores of this machine.

The delay of a simulated person is from sending a key to having read the turn that acknowledges it; that of
a browser from the key to the frame after the board is drawn. Waiting for the clock alone takes 62 ms at the
median and 119 ms at the 95th percentile. A turn is late if it comes 20 ms later than the clock says, by the
times that the server stores. Nothing of a real network is in it.

    python benchmarks/hosting.py
"""

import asyncio
import json
import random
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import aiohttp
import numpy as np
import psutil
import pyarrow.parquet as pq
import tyro
from rich.console import Console
from rich.table import Table

sys.path.append(str(Path(__file__).parents[1] / "docs"))

from viewers import NO_GPU, browser, free_port, wait_until

PACE: Final = 8.0
LATE_MS: Final = 20.0
KEYS_A_SECOND: Final = 4.0
ACTIONS: Final = ("forward", "left", "right", "turn_left", "turn_right")
START_S: Final = 120.0
IN_A_BROWSER: Final = """
    window.delays = [];
    const sent = new Map(), receive = RECEIVE.turn;
    const keys = ["ArrowUp", "ArrowLeft", "ArrowRight", "q", "e"];
    RECEIVE.turn = (news) => {
      receive(news);
      const began = sent.get(news.ack);
      if (began === undefined) return;
      sent.clear();
      requestAnimationFrame(() => setTimeout(() => delays.push(performance.now() - began)));
    };
    const press = () => {
      const key = keys[Math.floor(Math.random() * keys.length)];
      const before = state.number;
      dispatchEvent(new KeyboardEvent("keydown", {key}));
      dispatchEvent(new KeyboardEvent("keyup", {key}));
      if (state.number > before && state.turn?.turn > 0) sent.set(state.number, performance.now());
      setTimeout(press, 500 * Math.random());
    };
    press();
"""
"""Press keys at random times in the page, and note from each to the frame that shows what it did."""


@dataclass
class Load:
    """What was measured, in milliseconds where nothing else is said."""

    simulated: list[float] = field(default_factory=list)
    browsers: list[float] = field(default_factory=list)
    processor_s: float = 0.0
    wall_s: float = 0.0
    memory_bytes: int = 0
    strangers: int = 0
    """The connections of strangers, those that came again counted again."""
    gaps: Any = None
    """Between one turn and the next."""


@contextmanager
def hosted(folder: Path, people: int, groups: int, turns: int) -> Iterator[tuple[str, psutil.Process]]:
    """Host a session in a process of its own; yield its link and the process."""
    port = free_port()
    words = ["commons", "--people", str(people), "--groups", str(groups), "--agents", "sustainable"]
    words += [
        "--turns",
        str(turns),
        "--turns-a-second",
        str(PACE),
        "--practice-turns",
        "0",
        "--pause-seconds",
        "20",
    ]
    words += ["--out", str(folder), "--port", str(port)]
    server = subprocess.Popen([sys.executable, "-m", "cprl", "host", *words], stdout=subprocess.DEVNULL)
    try:
        wait_until(lambda: _answers(port), START_S, "cprl host did not answer")
        yield f"http://127.0.0.1:{port}/#{(folder / 'join.txt').read_text()}", psutil.Process(server.pid)
    finally:
        server.kill()
        server.wait()


def _answers(port: int) -> bool:
    return any(
        connection.laddr.port == port and connection.status == psutil.CONN_LISTEN
        for connection in psutil.net_connections("tcp")
    )


async def simulated(link: str, load: Load, rng: random.Random) -> None:
    """Play as a person who presses keys at random times until the end."""
    server, _, token = link.partition("/#")
    async with aiohttp.ClientSession() as session:
        seat = await (await session.post(f"{server}/join", json={"token": token})).json()
        async with session.ws_connect(f"{server}/socket", protocols=("cprl", seat["seat_token"])) as socket:
            sent: dict[int, float] = {}
            pressing: asyncio.Task[None] | None = None

            async def press() -> None:
                for number in range(1, 1_000_000):
                    await asyncio.sleep(rng.uniform(0, 2 / KEYS_A_SECOND))
                    sent[number] = time.perf_counter()
                    await socket.send_json(
                        {"type": "action", "action": rng.choice(ACTIONS), "number": number}
                    )

            async for message in socket:
                news = json.loads(message.data)
                if news["type"] == "round":
                    await socket.send_json({"type": "ready"})
                elif news["type"] == "turn" and news["turn"] > 0:
                    pressing = pressing or asyncio.create_task(press())
                    began = sent.get(news["ack"])
                    if began is not None:
                        load.simulated.append(1000 * (time.perf_counter() - began))
                        sent.clear()
                elif news["type"] in ("round_end", "end"):
                    break
            if pressing is not None:
                pressing.cancel()


async def stranger(port: int, load: Load) -> None:
    """Hold a connection open on which nothing is said, again and again."""
    while True:
        with suppress(OSError):
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            load.strangers += 1
            await reader.read()
            writer.close()
        await asyncio.sleep(0.01)


def at_a_browser(link: str, load: Load, has_ended: threading.Event) -> None:
    """Play as a person at a real browser until the round ends."""
    with browser(link, size=(1280, 800), graphics=NO_GPU) as window:
        wait_until(
            lambda: window.run("return document.body.dataset.stage === 'instructions'"), START_S, "no round"
        )
        window.run("document.getElementById('go').click()")
        wait_until(
            lambda: window.run("return document.body.dataset.stage === 'playing'"), START_S, "no start"
        )
        window.run(IN_A_BROWSER)
        has_ended.wait()
        load.browsers += window.run("return delays")


async def played(
    link: str, process: psutil.Process, load: Load, *, people: int, strangers: int, browsers: int
) -> None:
    """Play a round with all of them, and measure the server from its first turn to its last."""
    port = int(link.split(":")[2].partition("/")[0])
    beside = [asyncio.create_task(stranger(port, load)) for _ in range(strangers)]
    has_ended = threading.Event()
    at_browsers = [
        asyncio.create_task(asyncio.to_thread(at_a_browser, link, load, has_ended)) for _ in range(browsers)
    ]
    rng = random.Random(0)
    playing = [asyncio.create_task(simulated(link, load, random.Random(rng.random()))) for _ in range(people)]
    while not load.simulated:
        await asyncio.sleep(0.05)
    before = process.cpu_times()
    began = time.perf_counter()
    await asyncio.gather(*playing)
    after = process.cpu_times()
    load.wall_s = time.perf_counter() - began
    load.processor_s = after.user + after.system - before.user - before.system
    load.memory_bytes = process.memory_info().rss
    has_ended.set()
    await asyncio.gather(*at_browsers)
    for task in beside:
        task.cancel()


def spread(values: Any) -> str:
    """Return median, 95th percentile and largest of some milliseconds."""
    if not len(values):
        return "none"
    half, most = np.percentile(values, (50, 95))
    return f"{half:.0f}, {most:.0f}, {max(values):.0f}"


def main(
    *, people: int = 30, browsers: int = 2, groups: int = 4, strangers: int = 100, turns: int = 240
) -> None:
    """Print the table.

    Args:
        people: simulated ones.
        browsers: people at real browsers.
        groups: into which all of these are divided.
        strangers: connections on which nothing is said.
        turns: of the round.
    """
    load = Load()
    with TemporaryDirectory() as scratch:
        folder = Path(scratch, "session")
        with hosted(folder, (people + browsers) // groups, groups, turns) as (link, process):
            kinds = {"people": people, "strangers": strangers, "browsers": browsers}
            asyncio.run(played(link, process, load, **kinds))
            stored = folder / "round-1" / "turns.parquet"
            wait_until(stored.exists, START_S, "the round was not stored")
            times = pq.read_table(stored, columns=["turn", "ms"]).group_by("turn").aggregate([("ms", "min")])
            load.gaps = np.diff(np.sort(times["ms_min"].to_numpy()))
    late = int((load.gaps > 1000 / PACE + LATE_MS).sum())
    table = Table("measured", "value", title=f"{people + browsers} seats, {PACE:g} turns a second")
    table.add_row(
        "key to board, simulated, ms: p50, p95, most", f"{spread(load.simulated)} of {len(load.simulated):,}"
    )
    table.add_row(
        "key to board, Chromium, ms: p50, p95, most", f"{spread(load.browsers)} of {len(load.browsers):,}"
    )
    table.add_row("between turns, ms: p50, p95, most", spread(load.gaps))
    table.add_row(f"turns later than {LATE_MS:.0f} ms", f"{late} of {len(load.gaps)}")
    table.add_row("processor of the server", f"{load.processor_s / load.wall_s:.0%} of a core")
    table.add_row("memory of the server", f"{load.memory_bytes / 2**20:,.0f} MiB")
    table.add_row("connections of strangers", f"{load.strangers:,}")
    Console().print(table)


if __name__ == "__main__":
    tyro.cli(main)
