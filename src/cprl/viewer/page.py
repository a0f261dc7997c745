"""The page of Rerun's web viewer, and recordings for it to load, served on 127.0.0.1 alone."""

import mmap
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache
from http.client import HTTPException
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Lock, Thread
from typing import Any, Final
from urllib.parse import quote, unquote, urlsplit
from urllib.request import ProxyHandler, build_opener

LOCALHOST: Final = "127.0.0.1"

_FILES: Final[Mapping[str, str]] = {
    "index.html": "text/html",
    "re_viewer.js": "text/javascript",
    "re_viewer_bg.wasm": "application/wasm",
    "sw.js": "text/javascript",
    "favicon.ico": "image/x-icon",
}
"""The files of the web viewer, and their types."""

_START_S: Final = 30.0
_POLL_S: Final = 0.1
_QUERY: Final = "renderer=webgl&persist=0&hide_welcome_screen=1&theme=dark"


class Page:
    """Serves the web viewer of the installed Rerun, in threads that end with the process.

    `rerun.serve_web_viewer` listens on all interfaces; this listens on 127.0.0.1, and answers only requests
    that name it or localhost as their host. The viewer's files, 43 MB, are read when a browser first asks.
    """

    def __init__(self, recordings: Sequence[Path] = ()) -> None:
        self._recordings = [Path(recording) for recording in recordings]
        handler = type("Handler", (_Handler,), {"recordings": self._recordings})
        self._server = _Server((LOCALHOST, 0), handler)
        self.port = int(self._server.server_address[1])
        """The port of 127.0.0.1."""
        Thread(target=self._server.serve_forever, args=(_POLL_S,), daemon=True, name="cprl page").start()

    @property
    def recordings(self) -> list[str]:
        here = f"http://{LOCALHOST}:{self.port}/recordings"
        return [
            f"{here}/{number}/{quote(recording.name)}" for number, recording in enumerate(self._recordings)
        ]

    def address(self, *sources: str) -> str:
        """The address of the page that shows these sources in one viewer, by default the recordings."""
        urls = [f"url={quote(source, safe='')}" for source in sources or self.recordings]
        return f"http://{LOCALHOST}:{self.port}/?{'&'.join([*urls, _QUERY])}"

    def close(self) -> None:
        """Stops serving. A second call does nothing."""
        self._server.shutdown()
        self._server.server_close()


def headers_of(recordings: Sequence[Path], folder: Path) -> list[Path]:
    """Write recordings without all but layout and headers, for a viewer to load first.

    A browser may load a recording for minutes, and meanwhile would show old headers as the present.
    A recording that cannot be read is left out.
    """
    from rerun.chunk import RrdReader

    written = []
    for number, recording in enumerate(recordings):
        target = folder / f"header-{number}.rrd"
        with warnings.catch_warnings(), suppress(RuntimeError, subprocess.CalledProcessError):
            warnings.simplefilter("ignore")  # the recording of a run that was killed has no footer
            entities = {chunk.entity_path for chunk in RrdReader(recording).stream()} - {"/header"}
            drop = [word for entity in entities for word in ("--drop-entity", entity)]
            command = [viewer_binary(), "rrd", "filter", *drop, "--output", target, recording.absolute()]
            subprocess.run(list(map(str, command)), stderr=subprocess.DEVNULL, check=True)
            written.append(target)
    return written


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that goes away is no error."""


class _Handler(BaseHTTPRequestHandler):
    recordings: Sequence[Path] = ()

    def do_GET(self) -> None:
        """Answers with a file of the web viewer, or a recording, to who names 127.0.0.1 or localhost."""
        if urlsplit(f"//{self.headers.get('Host', '')}").hostname not in (LOCALHOST, "localhost"):
            self.send_error(403, f"allowed hosts: {LOCALHOST}, localhost")  # a name made to lead here
            return
        path = urlsplit(self.path).path.lstrip("/") or "index.html"
        for number, recording in enumerate(self.recordings):
            if unquote(path) == f"recordings/{number}/{recording.name}":
                with recording.open("rb") as file:
                    self._begin("application/octet-stream", os.fstat(file.fileno()).st_size)
                    shutil.copyfileobj(file, self.wfile)
                return
        if path not in _FILES:
            self.send_error(404)
            return
        try:
            with _ONE_AT_A_TIME:
                content = web_viewer()[path]
        except (OSError, HTTPException, TimeoutError) as error:
            self.send_error(503, "Rerun's web viewer cannot be read", str(error))
            return
        self._begin(_FILES[path], len(content))
        self.wfile.write(content)

    def _begin(self, kind: str, size: int) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(size))
        self.send_header("rerun-final-length", str(size))  # of which the page shows how much it has loaded
        self.end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing: the terminal is the command's."""


_ONE_AT_A_TIME: Final = Lock()


@cache
def web_viewer() -> Mapping[str, mmap.mmap]:
    """The files of the web viewer of the installed Rerun, by name, in a temporary file without a name.

    Rerun's command has them built in, and only hands them out as a server, which is started for a second.
    """
    port = free_port()
    command = [str(viewer_binary()), "--serve-web", "--bind", LOCALHOST, "--port", str(free_port())]
    process = subprocess.Popen(
        [*command, "--web-viewer-port", str(port)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "CI": "1"},  # without usage data
    )
    try:
        _wait_for(port, process)
        return {name: _fetched(f"http://{LOCALHOST}:{port}/{name}") for name in _FILES}
    finally:
        process.kill()
        process.wait()


def _fetched(address: str) -> mmap.mmap:
    opener = build_opener(ProxyHandler({}))
    with tempfile.TemporaryFile() as file, opener.open(address, timeout=_START_S) as answer:
        shutil.copyfileobj(answer, file, 2**20)
        file.flush()
        return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)


def _wait_for(port: int, process: "subprocess.Popen[bytes]") -> None:
    """Returns when the process listens at the port."""
    ends = time.monotonic() + _START_S
    while time.monotonic() < ends:
        if process.poll() is not None:
            raise OSError(f"{viewer_binary()} ended with code {process.returncode}")
        with socket.socket() as probe:
            if probe.connect_ex((LOCALHOST, port)) == 0:
                return
        time.sleep(0.05)
    raise TimeoutError(f"{viewer_binary()} did not answer within {_START_S:g} s")


def viewer_binary() -> Path:
    """Rerun's command itself; the script `rerun` beside Python leaves it running when it is ended."""
    import rerun_cli

    name = "rerun.exe" if sys.platform == "win32" else "rerun"
    return Path(next(iter(rerun_cli.__path__))) / name


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind((LOCALHOST, 0))
        return int(probe.getsockname()[1])


def has_display() -> bool:
    if not sys.platform.startswith("linux"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def viewer() -> str:
    """The command of Rerun's native viewer: the one next to this Python, if there is one, else that of the
    shell, else that of the package, which is neither where packages are installed into a folder of their own.
    """
    beside = Path(sys.executable).with_name("rerun")
    if beside.exists():
        return str(beside)
    return "rerun" if shutil.which("rerun") else str(viewer_binary())


def to_watch(*recordings: Path) -> list[str]:
    """Return the command line that opens recordings in the native viewer, whatever their names begin with."""
    return [viewer(), *(f"./{path}" if str(path).startswith("-") else str(path) for path in recordings)]
