"""Rerun's viewers: the native viewer's command, and the web viewer served on 127.0.0.1."""

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
from http.client import HTTPConnection, HTTPException
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread, current_thread, main_thread
from typing import Any, Final, Literal, get_args
from urllib.parse import quote

from cprl.system.output import quote_command
from cprl.values import checked

RECORDING_FILE: Final = "run.rrd"
LOCALHOST: Final = "127.0.0.1"
Served = Literal["serve", "spawn"]
"""The ways to watch a run live: serve it, or serve it and start Rerun's native viewer."""

_QUERY: Final = "renderer=webgl&persist=0&hide_welcome_screen=1&theme=dark"
_THIS_MACHINE: Final = (
    f"default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; connect-src 'self' http://{LOCALHOST}:*"
)
"""The Content-Security-Policy that forbids a browser to contact other machines."""
_REQUEST_PATH: Final = re.compile("/[!-~]*")
"""The paths that requests may have: printed ASCII characters without spaces."""
_RUN_UNTIL_STDIN_CLOSES: Final = '"$@" & read -r _; kill $!'
"""A shell script that runs its arguments as a command and ends it when standard input closes: so Rerun's
server ends with this process, even if this process is killed."""


def recording_file(number: int) -> str:
    """Return the name of a recording of a run's training: run.rrd, run-2.rrd and so on."""
    return RECORDING_FILE if number == 1 else f"run-{number}.rrd"


def recordings_of(run: Path) -> list[Path]:
    """Return the recordings of a run's training in their order."""
    paths = (run / recording_file(number) for number in itertools.count(1))
    return list(itertools.takewhile(Path.exists, paths))


class WebViewer:
    """The page on which a browser shows served recordings, on 127.0.0.1 only.

    Rerun's web server runs as a separate process, which ends with this one. Its page would fetch fonts from
    other machines and send usage data to Rerun's makers, and a browser cannot turn that off. A proxy in this
    process therefore serves the page with a header that forbids contact with other machines. The proxy also
    has a short address, which leads to the page that shows all recordings.

    Args:
        sources: the addresses at which the recordings are served.
        opened: called, in another thread, when a browser opens the page.
    """

    def __init__(self, *sources: str, opened: Callable[[], object] = lambda: None) -> None:
        rerun_port = free_port()
        command = [str(viewer_binary()), "--serve-web", "--bind", LOCALHOST, "--port", str(free_port())]
        command += ["--web-viewer-port", str(rerun_port)]
        if os.name == "posix":
            command = ["sh", "-c", _RUN_UNTIL_STDIN_CLOSES, "sh", *command]
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "CI": "1"},  # Rerun sends no usage data from CI
            start_new_session=True,  # so that Ctrl-C reaches only this process
        )
        page_path = "/?" + "&".join([*(f"url={quote(source, safe='')}" for source in sources), _QUERY])
        self._server = ThreadingHTTPServer(
            (LOCALHOST, 0), partial(_ProxyHandler, rerun_port, page_path, opened)
        )
        Thread(target=self._server.serve_forever, daemon=True).start()
        self.port = self._server.server_port
        self.native = [viewer(), "--connect", *sources]
        """The command of Rerun's native viewer."""
        self.addresses = {
            "browser": f"http://{LOCALHOST}:{self.port}/",
            "native": quote_command(self.native),
        }
        """The address for a "browser", and the command line of Rerun's "native" viewer."""

    def close(self) -> None:
        """Stop serving. A second call does nothing."""
        self._server.shutdown()
        self._server.server_close()
        if os.name != "posix":
            self._process.kill()
        if self._process.stdin is not None:
            self._process.stdin.close()
        self._process.wait()


class _ProxyHandler(BaseHTTPRequestHandler):
    """Redirects "/" to the page of the recordings, and passes other requests on to Rerun's web server.

    A request must name this machine as its host: so a foreign page whose name resolves to 127.0.0.1 gets
    nothing.
    """

    def __init__(
        self, rerun_port: int, page_path: str, opened: Callable[[], object], *arguments: Any
    ) -> None:
        self._rerun_port = rerun_port
        self._page_path = page_path
        self._opened = opened
        super().__init__(*arguments)

    def handle(self) -> None:
        with suppress(ConnectionError):  # the browser left before it had the answer
            super().handle()

    def do_GET(self) -> None:
        port = self.connection.getsockname()[1]
        if self.headers.get("Host") not in (f"{LOCALHOST}:{port}", f"localhost:{port}"):
            self.send_error(HTTPStatus.FORBIDDEN)
            return
        if not _REQUEST_PATH.fullmatch(self.path):
            self.send_error(HTTPStatus.BAD_REQUEST)
            return
        if self.path == "/":
            self.send_response(HTTPStatus.FOUND)
            self.send_header("Location", self._page_path)
            self.end_headers()
            return
        if self.path.startswith("/?"):
            self._opened()
        self._pass_on()

    def _pass_on(self) -> None:
        """Answer with the content of Rerun's web server, and forbid the page to contact other machines."""
        rerun = HTTPConnection(LOCALHOST, self._rerun_port)
        try:
            rerun.request("GET", self.path)
            answer = rerun.getresponse()
            content = answer.read()
        except (OSError, HTTPException):
            self.send_error(HTTPStatus.SERVICE_UNAVAILABLE)
            return
        finally:
            rerun.close()
        self.send_response(answer.status)
        self.send_header("Content-Type", answer.getheader("Content-Type", "text/plain"))
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Content-Security-Policy", _THIS_MACHINE)
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *arguments: Any) -> None:
        """Print no line for each request."""


def viewer_binary() -> Path:
    """Return the path of Rerun's program. Killing the script `rerun` beside Python would leave it running."""
    import rerun_cli

    name = "rerun.exe" if sys.platform == "win32" else "rerun"
    return Path(next(iter(rerun_cli.__path__))) / name


def viewer() -> str:
    """Return the command of Rerun's native viewer: the script beside this Python, else the one on the PATH,
    else the program in Rerun's package."""
    script = Path(sys.executable).with_name("rerun")
    if script.exists():
        return str(script)
    return "rerun" if shutil.which("rerun") else str(viewer_binary())


def to_watch(*recordings: Path) -> list[str]:
    """Return the command line that opens recordings in the native viewer."""
    # A name like "-x.rrd" would be read as an option.
    return [viewer(), *(f"./{path}" if str(path).startswith("-") else str(path) for path in recordings)]


def free_port() -> int:
    """Return the number of a port of 127.0.0.1 that no program uses."""
    with socket.socket() as probe:
        probe.bind((LOCALHOST, 0))
        return int(probe.getsockname()[1])


def has_display() -> bool:
    """Return whether windows can be opened on this machine."""
    if not sys.platform.startswith("linux"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def check_watch(watch: str, *, linger: bool = False, can_be_off: bool = True) -> None:
    """Check how a run is to be watched, before it starts.

    Args:
        watch: "file" to record to a file; "serve" or "spawn" to also show the recording live, see
            `cprl.viewer.live.Live`; "off" for no recording.
        linger: whether the recording stays served after the run. That needs a served recording, and the main
            thread, which waits for the signal to stop.
        can_be_off: whether "off" is allowed.

    Raises:
        ValueError: for another word, and where `linger` is not possible.
    """
    allowed: Any = Literal["file", Served, "off"] if can_be_off else Literal["file", Served]
    checked("watch", watch, allowed)
    if linger and watch not in get_args(Served):
        raise ValueError(
            f'linger is True, but watch is "{watch}", which serves nothing; allowed: watch "serve" or "spawn"'
        )
    if linger and current_thread() is not main_thread():
        raise ValueError("linger is True in another thread than the main one, which alone gets signals")
