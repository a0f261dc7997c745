"""How recordings are opened: Rerun's viewers, native and in a browser, and a run that stays served."""

import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from threading import Event, current_thread, main_thread
from typing import TYPE_CHECKING, Final, Literal, get_args
from urllib.parse import quote

from cprl.system.output import console
from cprl.system.process import at_signals
from cprl.values import checked

if TYPE_CHECKING:
    from cprl.viewer.logger import RerunLogger

LOCALHOST: Final = "127.0.0.1"
Served = Literal["serve", "spawn"]

_QUERY: Final = "renderer=webgl&persist=0&hide_welcome_screen=1&theme=dark"
_UNTIL_THE_PIPE_CLOSES: Final = '"$@" & read -r _; kill $!'
"""A shell ends Rerun's server when this process ends, even when it is killed."""


class WebViewer:
    """Rerun's own server of its web viewer, and of recordings, on 127.0.0.1 alone.

    It is a process of its own, which ends with this one.

    Args:
        recordings: files that it serves; a page of it can show what others serve too.
    """

    def __init__(self, recordings: Sequence[Path] = ()) -> None:
        self.port, data_port = free_port(), free_port()
        self.data = f"rerun+http://{LOCALHOST}:{data_port}/proxy"
        """The address at which it serves the recordings."""
        command = [str(viewer_binary()), "--serve-web", "--bind", LOCALHOST, "--port", str(data_port)]
        command += ["--web-viewer-port", str(self.port), *(str(path.absolute()) for path in recordings)]
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

    def address(self, *sources: str) -> str:
        """The address of the page that shows these sources in one viewer, by default the recordings."""
        urls = [f"url={quote(source, safe='')}" for source in sources or (self.data,)]
        return f"http://{LOCALHOST}:{self.port}/?{'&'.join([*urls, _QUERY])}"

    def close(self) -> None:
        """Stop serving. A second call does nothing."""
        if os.name != "posix":
            self._process.kill()
        if self._process.stdin is not None:
            self._process.stdin.close()
        self._process.wait()


def viewer_binary() -> Path:
    """Rerun's command itself; the script `rerun` beside Python leaves it running when it is ended."""
    import rerun_cli

    name = "rerun.exe" if sys.platform == "win32" else "rerun"
    return Path(next(iter(rerun_cli.__path__))) / name


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
    checked("watch", watch, Literal["file", "off"] | Served if can_be_off else Literal["file"] | Served)
    if linger and watch not in get_args(Served):
        raise ValueError(
            f'linger is True, but watch is "{watch}", which serves nothing; allowed: watch "serve" or "spawn"'
        )
    if linger and current_thread() is not main_thread():
        raise ValueError("linger is True in another thread than the main one, which alone gets signals")


def linger(logger: "RerunLogger", play_on: Callable[[Event], None] | None = None) -> None:
    """Says where the recording stays served, waits for Ctrl-C (SIGINT) or SIGTERM, and closes the recording;
    a second signal in the meantime changes nothing.
    """
    if not logger.is_live:
        console().print("The recording is no longer served.")
        return
    stopping = Event()
    with at_signals(lambda number: stopping.set()):
        where = logger.addresses["browser"]
        console().print(
            f"The recording stays served at {where} until Ctrl-C", soft_wrap=True, highlight=False
        )
        if play_on is not None:
            play_on(stopping)
        while not stopping.wait(1.0):
            pass
        logger.shutdown()
