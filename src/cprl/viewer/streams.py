"""The streams of one recording: to a file and, on request, live on 127.0.0.1."""

import shutil
import subprocess
import sys
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from cprl import arguments
from cprl.output import printed
from cprl.viewer.deadline import exit_in_time
from cprl.viewer.page import LOCALHOST, Page, free_port, has_display, viewer_binary
from cprl.viewer.sending import LiveStream, Stream

RUN, REPLAY = "cprl", "cprl replay"
"""The application ids of runs and of replays: a viewer keeps one layout for each. Recordings of a run that is
resumed must have that of its first one."""

SERVER_MEMORY: Final = "512MB"
"""The memory limit of the served recording; beyond it viewers lose the oldest rows, the file does not."""

EXHIBITION_MEMORY: Final = "1MB"
"""The same of the exhibition, of which viewers need the newest frame alone."""

NEEDED_BYTES: Final = 2_000_000
"""The free disk space needed to start a recording; its layout and static parts take a tenth."""

_LIVE: Final = "serve", "spawn"


def check_watch(watch: str, *, can_be_off: bool = True) -> None:
    """Checks a recipe's `watch` before the run starts.

    Args:
        watch: "file", or live as well, see `open_live`; "off" for no recording.
        can_be_off: whether "off" is allowed.

    Raises:
        ValueError: if the value is not allowed; names it and the allowed values.
    """
    arguments.choice("watch", watch, ("file", *(("off",) if can_be_off else ()), *_LIVE))


@dataclass(frozen=True)
class Live:
    """What viewers are sent."""

    stream: Stream | None = None
    """The recording; None without a viewer."""
    exhibition: Stream | None = None
    """Where the exhibition is sent, which waits between its frames; a server of its own, since a server that
    has used its memory drops the oldest rows of all. None where nothing is exhibited."""
    addresses: dict[str, str] = field(default_factory=dict)
    """How to watch: "browser" and "native"."""
    page: Page | None = None
    """The page of the web viewer."""

    def close(self) -> None:
        """Closes the exhibition and the page; the recording is closed with the file."""
        if self.exhibition is not None:
            self.exhibition.close()
        if self.page is not None:
            self.page.close()


def open_file(
    recording_id: str, path: Path, blueprint: Any, *, period_s: float, application: str = RUN
) -> Stream | None:
    """A stream to a new file; None, with a warning, if the disk is almost full.

    Otherwise Rerun may wait forever for the layout to be written.
    """
    free = shutil.disk_usage(path.parent).free
    if free < NEEDED_BYTES:
        _warn_of(f"file {path}", f"{free:,} bytes are free there, {NEEDED_BYTES:,} are needed")
        return None
    recording = _recording(application, recording_id)
    recording.save(path, default_blueprint=blueprint)
    return Stream("file", recording, period_s=period_s)


def open_live(
    live: str,
    recording_id: str,
    blueprint: Any,
    *,
    period_s: float,
    application: str = RUN,
    exhibits: bool = False,
) -> Live:
    """A live stream, one for the exhibition if there is any, and how to watch them.

    Args:
        live: "serve": serves the recording on free ports of 127.0.0.1; viewers can connect at any time and
            get the history. "spawn": the same, and starts Rerun's native viewer.
        recording_id: the id of the recording.
        blueprint: its layout.
        period_s: seconds between two batches of buffered numbers.
        application: the application id, `RUN` or `REPLAY`.
        exhibits: whether there is an exhibition.

    Raises:
        ValueError: if `live` is anything else.
    """
    arguments.choice("live", live, _LIVE)
    recording = _recording(application, recording_id)
    stream, *grpc = _serve("live view", recording, blueprint, period_s, SERVER_MEMORY)
    exhibition = None
    if exhibits:  # with the layout as well: a viewer may hear of the recording here first
        recording = _recording(application, recording_id, send_properties=False)
        exhibition, address = _serve("exhibition", recording, blueprint, period_s, EXHIBITION_MEMORY)
        grpc.append(address)
    if live == "spawn":
        _spawn(grpc)
    page, native = Page(), printed([viewer(), "--connect", *grpc])
    return Live(stream, exhibition, {"browser": page.address(*grpc), "native": native}, page)


def _serve(name: str, recording: Any, blueprint: Any, period_s: float, memory: str) -> tuple[Stream, str]:
    """A stream served on a free port of 127.0.0.1, and its address."""
    import rerun as rr

    exit_in_time()
    port = free_port()
    recording.set_sinks(
        rr.GrpcServerSink(LOCALHOST, port, server_memory_limit=memory), default_blueprint=blueprint
    )
    return LiveStream(name, recording, period_s=period_s), f"rerun+http://{LOCALHOST}:{port}/proxy"


def _spawn(grpc: list[str]) -> None:
    """Starts Rerun's native viewer in its own process; warns if it cannot open."""
    if not has_display():
        _warn_of("viewer cannot open", "there is no display; open one of the addresses from elsewhere")
        return
    try:
        subprocess.Popen(
            [viewer(), "--connect", *grpc],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
    except OSError as error:
        _warn_of("viewer cannot be started", error)


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


def _warn_of(what: str, why: object) -> None:
    warnings.warn(f"the Rerun {what}: {why}; the run continues without it", RuntimeWarning, stacklevel=3)


def _recording(application: str, recording_id: str, *, send_properties: bool = True) -> Any:
    import rerun as rr

    recording = rr.RecordingStream(
        application,
        recording_id=recording_id,
        send_properties=send_properties,
        batcher_config=rr.ChunkBatcherConfig(flush_num_rows=1),  # columns would overtake rows that wait
    )
    recording.set_log_time_enabled(False)
    return recording
