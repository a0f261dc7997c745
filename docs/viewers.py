"""Real viewers without a screen, and the pictures they show: Rerun's own, and its web viewer in Chromium.

Rerun's own wants Vulkan drivers (Debian: mesa-vulkan-drivers, libvulkan1), the other chromium and
chromium-driver; `make test-viewer` installs what is missing.
"""

import base64
import json
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from urllib.error import HTTPError, URLError
from urllib.request import Request, urlopen

import rerun_cli
from rerun.experimental import ViewerClient

VIEWER = Path(rerun_cli.__path__[0]) / "rerun"
"""The viewer itself: the console script `rerun` would leave it running when it is ended."""

START_S = 120.0
STEADY_S = 300.0
BUSY_S = 600.0
"""The longest waits, on a machine with much other work."""

CHROMIUM = (
    *("--headless", "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync", "--force-color-profile=srgb"),
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1, EXCLUDE localhost",
)
WEB_GL = (
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
)
"""WebGL by SwiftShader on the CPU, a frame a second; with WebGPU there the web viewer crashes."""
NO_GPU = ("--disable-gpu",)
"""Pages without WebGL, at the pace of a screen."""


@contextmanager
def native_viewer(
    *, connect_to: Sequence[str] = (), size: tuple[int, int] = (1600, 1000)
) -> Iterator[ViewerClient]:
    """Rerun's own viewer, headless, by its remote control.

    Args:
        connect_to: the addresses of a live recording, see `RerunLogger.addresses`; none for an empty viewer.
        size: of the window, in pixels.
    """
    port = free_port()
    command = [VIEWER, "--headless", "--hide-welcome-screen", "--window-size", f"{size[0]}x{size[1]}"]
    command += ["--bind", "127.0.0.1", "--port", str(port)]
    viewer = subprocess.Popen(
        [*command, *(["--connect", *connect_to] if connect_to else [])],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        yield _remote_control(port, viewer)
    finally:
        viewer.kill()
        viewer.wait()


def _remote_control(port: int, viewer: "subprocess.Popen[bytes]") -> ViewerClient:
    """Return the address of a viewer, once it answers."""
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
    """Return a screenshot that two looks in a row agree on, PNG."""
    seen: list[bytes] = [b"", client.take_screenshot()]

    def steady() -> bool:
        seen[:] = [seen[-1], client.take_screenshot()]
        return seen[0] == seen[1]

    wait_until(steady, STEADY_S, "the picture did not come to rest", every_s=0.7)
    return seen[-1]


@contextmanager
def browser(
    page: str, *, size: tuple[int, int] = (1600, 1000), graphics: Sequence[str] = WEB_GL
) -> Iterator["Browser"]:
    """Headless Chromium with a page open; what is handed out, when called, takes a picture of it, PNG.

    Chromium is driven by chromium-driver, which speaks WebDriver: JSON over HTTP, no library is needed.

    Raises:
        FileNotFoundError: without chromium-driver.
    """
    driver = shutil.which("chromedriver")
    if driver is None:
        raise FileNotFoundError("there is no chromedriver; `make test-viewer` installs chromium-driver")
    port = free_port()
    process = subprocess.Popen(
        [driver, f"--port={port}"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    address = f"http://127.0.0.1:{port}"
    session = ""
    with tempfile.TemporaryDirectory() as profile:
        flags = [*CHROMIUM, *graphics, f"--user-data-dir={profile}", f"--window-size={size[0]},{size[1]}"]
        wanted = {"alwaysMatch": {"goog:chromeOptions": {"args": flags}}}
        try:
            wait_until(lambda: _is_ready(address), START_S, "chromedriver did not answer")
            session = (
                f"{address}/session/{_asked(f'{address}/session', {'capabilities': wanted})['sessionId']}"
            )
            opened = Browser(session)
            opened.open(page)
            yield opened
        finally:
            if session:
                with suppress(RuntimeError, OSError):  # a busy page may not answer; it ends with the driver
                    _asked(session, method="DELETE")
            process.terminate()
            process.wait()


class Browser:
    """A browser's window.

    Args:
        session: the address of its WebDriver session.
    """

    def __init__(self, session: str) -> None:
        self._session = session

    def __call__(self) -> bytes:
        """Return a picture of what is in the window, PNG."""
        return base64.b64decode(_patiently(f"{self._session}/screenshot"))

    def open(self, page: str) -> None:
        """Open an address, and wait until it is loaded."""
        _asked(f"{self._session}/url", {"url": page})

    def run(self, script: str) -> Any:
        """Return what a piece of JavaScript returns in the page."""
        return _asked(f"{self._session}/execute/sync", {"script": script, "args": []})

    def resize(self, width: int, height: int) -> None:
        """Show the page as a device of this size would; windows of Chromium are 500 wide at least."""
        sizes = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.command("Emulation.setDeviceMetricsOverride", **sizes)

    def command(self, name: str, **params: Any) -> None:
        """Have Chromium do what its DevTools can: real keys and fingers, a dark scheme."""
        _asked(f"{self._session}/goog/cdp/execute", {"cmd": name, "params": params})


def _is_ready(address: str) -> bool:
    try:
        return bool(_asked(f"{address}/status")["ready"])
    except URLError:
        return False


def _patiently(address: str) -> Any:
    """Return what WebDriver answers at last: it waits ten seconds for a page that may be busy drawing."""
    began = time.monotonic()
    while True:
        try:
            return _asked(address)
        except (RuntimeError, TimeoutError) as error:
            is_busy = isinstance(error, TimeoutError) or "renderer" in str(error)
            if not is_busy or time.monotonic() - began > BUSY_S:
                raise
            time.sleep(1)


def _asked(address: str, body: Mapping[str, Any] | None = None, *, method: str | None = None) -> Any:
    """Return what WebDriver answers."""
    data = None if body is None else json.dumps(body).encode()
    request = Request(address, data, {"Content-Type": "application/json"}, method=method)
    try:
        with urlopen(request, timeout=120) as answer:
            return json.load(answer)["value"]
    except HTTPError as error:
        raise RuntimeError(f"chromedriver says to {address}: {error.read().decode()[:300]}") from error


def free_port() -> int:
    """Return a port of 127.0.0.1 that nobody listens at."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def wait_until(condition: Callable[[], bool], limit_s: float, trouble: str, *, every_s: float = 0.2) -> None:
    """Wait for a condition, at most so long."""
    began = time.monotonic()
    while not condition():
        if time.monotonic() - began > limit_s:
            raise TimeoutError(f"{trouble} within {limit_s:.0f} s")
        time.sleep(every_s)
