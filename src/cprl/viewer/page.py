"""How recordings are opened: Rerun's viewers, native and in a browser."""

import itertools
import os
import re
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from http import HTTPStatus
from http.client import HTTPException
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread, current_thread, main_thread
from typing import Any, Final, Literal, get_args
from urllib.parse import quote
from urllib.request import ProxyHandler, build_opener

from cprl.system.output import printed
from cprl.values import checked

FILE_NAME: Final = "run.rrd"
LOCALHOST: Final = "127.0.0.1"
Served = Literal["serve", "spawn"]

_QUERY: Final = "renderer=webgl&persist=0&hide_welcome_screen=1&theme=dark"
_THIS_MACHINE: Final = (
    f"default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; connect-src 'self' http://{LOCALHOST}:*"
)
"""Rerun's page would ask other machines for fonts, and tell one of its use."""
_OPEN: Final = build_opener(ProxyHandler({})).open
"""Past the proxies of the environment, which do not know the ports of this machine."""
_PATH: Final = re.compile("/[!-~]*")
"""What a request may ask for: printed ASCII characters without spaces."""
_UNTIL_THE_PIPE_CLOSES: Final = '"$@" & read -r _; kill $!'
"""A shell ends Rerun's server when this process ends, even when it is killed."""


def recordings_of(run: Path) -> list[Path]:
    """Return the recordings of a run so far, in their order: run.rrd, run-2.rrd and so on; films are none."""
    names = (FILE_NAME if number == 1 else f"run-{number}.rrd" for number in itertools.count(1))
    return list(itertools.takewhile(Path.exists, (run / name for name in names)))


class WebViewer:
    """The page at which a browser shows what is served at some addresses, on 127.0.0.1 alone.

    Rerun's own server of its web viewer is a process of its own, which ends with this one. The address of its
    page names all others, so a server with a short one leads there and hands out what it serves.

    Args:
        opened: called when a browser opens the page, from another thread.
    """

    def __init__(self, *sources: str, opened: Callable[[], object] = lambda: None) -> None:
        port = free_port()
        command = [str(viewer_binary()), "--serve-web", "--bind", LOCALHOST, "--port", str(free_port())]
        command += ["--web-viewer-port", str(port)]
        if os.name == "posix":
            command = ["sh", "-c", _UNTIL_THE_PIPE_CLOSES, "sh", *command]
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "CI": "1"},  # without usage data
            start_new_session=True,  # Ctrl-C is for this process alone
        )
        page = "/?" + "&".join([*(f"url={quote(source, safe='')}" for source in sources), _QUERY])
        handler = partial(_Page, f"http://{LOCALHOST}:{port}", page, opened)
        self._server = ThreadingHTTPServer((LOCALHOST, 0), handler)
        Thread(target=self._server.serve_forever, daemon=True).start()
        self.port = self._server.server_port
        self.addresses = {
            "browser": f"http://{LOCALHOST}:{self.port}/",
            "native": printed([viewer(), "--connect", *sources]),
        }
        """How to watch, in a browser and in Rerun's native viewer."""

    def close(self) -> None:
        """Stop serving. A second call does nothing."""
        self._server.shutdown()
        self._server.server_close()
        if os.name != "posix":
            self._process.kill()
        if self._process.stdin is not None:
            self._process.stdin.close()
        self._process.wait()


class _Page(BaseHTTPRequestHandler):
    """Leads to a page of another server, and hands out what that one serves, where it is asked by the name of
    this machine: a foreign page that has bound its own name to 127.0.0.1 gets nothing."""

    def __init__(self, origin: str, page: str, opened: Callable[[], object], *arguments: Any) -> None:
        self._origin = origin
        self._page = page
        self._opened = opened
        super().__init__(*arguments)

    def handle(self) -> None:
        with suppress(ConnectionError):  # a browser that leaves
            super().handle()

    def do_GET(self) -> None:
        port = self.connection.getsockname()[1]
        if self.headers.get("Host") not in (f"{LOCALHOST}:{port}", f"localhost:{port}"):
            self.send_error(HTTPStatus.FORBIDDEN)
            return
        if not _PATH.fullmatch(self.path):
            self.send_error(HTTPStatus.BAD_REQUEST)
            return
        if self.path == "/":
            self.send_response(HTTPStatus.FOUND)
            self.send_header("Location", self._page)
            self.end_headers()
            return
        if self.path.startswith("/?"):
            self._opened()
        try:
            with _OPEN(self._origin + self.path) as answer:
                content = answer.read()
        except (OSError, HTTPException) as error:
            self.send_error(getattr(error, "code", HTTPStatus.SERVICE_UNAVAILABLE))
            return
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", answer.headers["Content-Type"])
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Content-Security-Policy", _THIS_MACHINE)
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *arguments: Any) -> None:
        """Say nothing."""


def viewer_binary() -> Path:
    """Rerun's command itself; the script `rerun` beside Python leaves it running when it is ended."""
    import rerun_cli

    name = "rerun.exe" if sys.platform == "win32" else "rerun"
    return Path(next(iter(rerun_cli.__path__))) / name


def viewer() -> str:
    """Return the command of Rerun's native viewer: the one next to this Python, if there is one, else that of
    the shell, else that of the package, which is neither where packages are installed into a folder of their
    own."""
    beside = Path(sys.executable).with_name("rerun")
    if beside.exists():
        return str(beside)
    return "rerun" if shutil.which("rerun") else str(viewer_binary())


def to_watch(*recordings: Path) -> list[str]:
    """Return the command line that opens recordings in the native viewer, whatever their names begin with."""
    return [viewer(), *(f"./{path}" if str(path).startswith("-") else str(path) for path in recordings)]


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind((LOCALHOST, 0))
        return int(probe.getsockname()[1])


def has_display() -> bool:
    if not sys.platform.startswith("linux"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def check_watch(watch: str, *, linger: bool = False, can_be_off: bool = True) -> None:
    """Check how a run is watched before it starts.

    Args:
        watch: "file", or live as well, "serve" or "spawn", see `cprl.viewer.live.Live`; "off" for no
            recording.
        linger: whether the recording stays served after the run, which needs signals and something served.
    """
    checked("watch", watch, Literal["file", Served, "off"] if can_be_off else Literal["file", Served])
    if linger and watch not in get_args(Served):
        raise ValueError(
            f'linger is True, but watch is "{watch}", which serves nothing; allowed: watch "serve" or "spawn"'
        )
    if linger and current_thread() is not main_thread():
        raise ValueError("linger is True in another thread than the main one, which alone gets signals")
