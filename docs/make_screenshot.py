"""A picture of the Rerun viewer, of a recording or of a live run, without a screen.

Needs Debian's mesa-vulkan-drivers and libvulkan1, or a graphics card.

    python docs/make_screenshot.py runs/.../run.rrd docs/viewer.png
    python docs/make_screenshot.py rerun+http://127.0.0.1:9876/proxy docs/viewer.png
"""

import socket
import subprocess
import time
from pathlib import Path

import rerun_cli
import tyro
from rerun.experimental import ViewerClient

VIEWER = Path(rerun_cli.__path__[0]) / "rerun"
"""The viewer itself: the console script `rerun` would leave it running when it is ended."""

START_S, STEADY_S = 30.0, 60.0


def main(
    source: str, target: Path, /, *, size: str = "1600x1000", at_step: int | None = None, live_s: float = 0.0
) -> None:
    """Opens the recording in a headless viewer, waits until the picture is steady, and keeps it.

    Args:
        source: a .rrd file, or the address of a live run (rerun+http://...).
        target: the PNG.
        size: of the window, in pixels.
        at_step: the step to show; by default where the viewer opens it.
        live_s: for a live run, whose picture is never steady: seconds to watch before the picture is taken.
    """
    port = free_port()
    live = source.startswith("rerun+")
    command = [VIEWER, "--headless", "--hide-welcome-screen", "--window-size", size]
    command += ["--bind", "127.0.0.1", "--port", str(port), *(["--connect", source] if live else [])]
    viewer = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        client = connect(port, viewer)
        if not live:
            client.open(str(Path(source).resolve()))
        time.sleep(1 + live_s)
        wait_until(lambda: not client.get_state().loading, START_S, "the viewer did not finish loading")
        if at_step is not None:
            client.set_time("step", sequence=at_step, play_state="paused")
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(client.take_screenshot() if live_s else steady_picture(client))
    finally:
        viewer.kill()
        viewer.wait()
    print(target)


def free_port() -> int:
    """A port of 127.0.0.1 that nobody listens at."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def connect(port: int, viewer: subprocess.Popen) -> ViewerClient:
    """The viewer's remote control, once it answers."""
    found: list[ViewerClient] = []

    def answers() -> bool:
        if viewer.poll() is not None:
            raise RuntimeError(
                f"the viewer ended at once, code {viewer.returncode}; are Vulkan drivers there?"
            )
        try:
            client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            client.get_state()
        except Exception:
            return False
        found.append(client)
        return True

    wait_until(answers, START_S, "the viewer did not answer")
    return found[0]


def steady_picture(client: ViewerClient) -> bytes:
    """A screenshot that two looks in a row agree on."""
    seen: list[bytes] = [b"", client.take_screenshot()]

    def steady() -> bool:
        seen[:] = [seen[-1], client.take_screenshot()]
        return seen[0] == seen[1]

    wait_until(steady, STEADY_S, "the picture did not come to rest", every_s=0.7)
    return seen[-1]


def wait_until(condition, limit_s: float, trouble: str, *, every_s: float = 0.2) -> None:
    """Waits for a condition, at most so long."""
    began = time.monotonic()
    while not condition():
        if time.monotonic() - began > limit_s:
            raise TimeoutError(f"{trouble} within {limit_s:.0f} s")
        time.sleep(every_s)


if __name__ == "__main__":
    tyro.cli(main)
