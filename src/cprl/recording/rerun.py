"""RerunLogger: a run as a Rerun recording, to a file and, on request, served live on 127.0.0.1."""

import socket
import sys
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeAlias
from urllib.parse import quote

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torchrl.record.loggers import Logger

from cprl.commons.game import CLASS_NAMES, COLOURS
from cprl.commons.picture import agent_colour
from cprl.recording.blueprint import layout
from cprl.recording.frames import RIM_CELLS, UNSEEN, board_with_rim, mosaic

FILE_NAME: Final = "run.rrd"
LOCALHOST: Final = "127.0.0.1"
SERVER_MEMORY: Final = "512MB"
"""What the served recording may hold; beyond it the oldest rows are dropped, for viewers alone."""

Numbers: TypeAlias = "Sequence[int] | NDArray[np.integer[Any]]"

LINES: Final = {
    "social/survival_steps": ("survival_steps", (230, 160, 0)),
    "social/sustainability": ("sustainability", (0, 158, 115)),
    "social/equality": ("equality", (86, 180, 233)),
    "social/peacefulness": ("peacefulness", (204, 121, 167)),
    "time/env_steps_per_s": ("steps per second", (150, 150, 150)),
    "evaluation/greedy_return": ("greedy, evaluated", (230, 160, 0)),
}
"""The name and colour of a line, since the viewers' own colours differ; agents have theirs."""

_LIVE_PERIOD_S: Final = 1.0
_FILE_PERIOD_S: Final = 10.0
_FLUSH_TIMEOUT_S: Final = 5.0
AGENT_RADIUS_CELLS: Final = 0.48
_ARROW_CELLS: Final = 0.9
_OUT_OF_PLAY_ALPHA: Final = 60


@dataclass(frozen=True, kw_only=True)
class Scene:
    """What is on the board that a recording shows."""

    height: int
    width: int
    agents: tuple[str, ...]
    """Names of the agents, agent 0 first."""
    window: tuple[int, int]
    """(X, Y) of a window."""


class _Stream:
    """One recording stream that may fail: then a warning says so once, and the run goes on without it."""

    def __init__(self, name: str, recording: Any) -> None:
        self.name, self.recording = name, recording

    def do(self, what: Callable[[Any], object]) -> None:
        """Does something with the stream, if it is still there."""
        if self.recording is None:
            return
        try:
            what(self.recording)
        except Exception as error:
            self.recording = None
            warnings.warn(
                f"the Rerun {self.name} is dropped, the run goes on without it: {error}",
                RuntimeWarning,
                stacklevel=2,
            )


class RerunLogger(Logger):
    """TorchRL's logger interface on a Rerun recording; names become entities, `social/equality` and so on.

    Numbers wait in memory and are sent as columns: to the viewer about every second, to the file about
    every ten. Every row carries the timelines `step` (environment steps of the run), `episode` and `frame`
    (frames recorded so far). The file and the live recording are two streams of one recording id, so that
    one may fail without the other; whatever fails is dropped with one warning.

    Args:
        exp_name: the name that the viewer shows.
        log_dir: the run's directory, where `run.rrd` is written.
        scene: what is on the board; without it no frames can be logged.
        serve: whether to serve the recording live; `addresses` tells where. The recording is served on
            127.0.0.1 alone; the empty page of the web viewer, which Rerun serves, listens on all interfaces.

    Raises:
        FileExistsError: where there is a recording already.
    """

    def __init__(
        self, exp_name: str, log_dir: str | Path, *, scene: Scene | None = None, serve: bool = False
    ) -> None:
        self.scene = scene
        self.path = Path(log_dir) / FILE_NAME
        if self.path.exists():
            raise FileExistsError(
                f"{self.path} exists and is kept; give the recording a directory of its own"
            )
        self.addresses: dict[str, str] = {}
        self._serve = serve
        self._streams: list[_Stream] = []
        self._waiting: dict[str, dict[str, list[tuple[int, int, int, float]]]] = {}
        self._sent: dict[str, float] = {}
        self._frames = 0
        self._now = (0, 0)
        super().__init__(exp_name, str(log_dir))

    def _create_experiment(self) -> list[Any]:
        import rerun as rr

        recording_id = f"{self.exp_name}-{time.time_ns()}"

        def stream() -> Any:
            recording = rr.RecordingStream("cprl", recording_id=recording_id)
            recording.set_log_time_enabled(False)
            return recording

        blueprint = layout(self.scene.agents if self.scene else ())
        to_file = stream()
        to_file.save(self.path, default_blueprint=blueprint)
        self._streams.append(_Stream("file", to_file))
        if self._serve:
            live = stream()
            grpc = _free_port()
            live.set_sinks(
                rr.GrpcServerSink(LOCALHOST, grpc, server_memory_limit=SERVER_MEMORY),
                default_blueprint=blueprint,
            )
            self._streams.append(_Stream("live view", live))
            self.addresses = _addresses(f"rerun+http://{LOCALHOST}:{grpc}/proxy")
        now = time.perf_counter()
        for each in self._streams:
            self._waiting[each.name], self._sent[each.name] = {}, now
        self._all(lambda recording: recording.send_recording_name(self.exp_name))
        self._log_scenery()
        self._all(lambda recording: recording.flush(timeout_sec=_FLUSH_TIMEOUT_S))
        return [each.recording for each in self._streams]

    def _all(self, what: Callable[[Any], object]) -> None:
        for each in self._streams:
            each.do(what)

    def _static(self, entity: str, *what: Any) -> None:
        self._all(lambda recording: recording.log(entity, *what, static=True))

    def _send(self, entity: str, times: list[Any], columns: Any) -> None:
        self._all(lambda recording: recording.send_columns(entity, times, columns))

    def _log_scenery(self) -> None:
        """What never changes: colours of classes and lines, names, sizes of images."""
        import rerun as rr

        classes = [
            rr.AnnotationInfo(id=kind, label=CLASS_NAMES[kind], color=COLOURS[kind])
            for kind in range(len(COLOURS))
        ]
        between = rr.AnnotationInfo(id=UNSEEN, label="", color=(0, 0, 0, 0))
        self._static("/", rr.AnnotationContext([*classes, between]))
        for entity, (name, colour) in LINES.items():
            self._static(entity, rr.SeriesLines(names=[name], colors=[colour]))
        if self.scene is None:
            return
        for agent, name in enumerate(self.scene.agents):
            for entity in ("return", "loss", "epsilon"):
                line = rr.SeriesLines(names=[name], colors=[agent_colour(agent)])
                self._static(f"{name}/{entity}", line)
        wide = len(self.scene.agents) * (self.scene.window[1] + 1) - 1
        for entity, width, height in (
            ("world/board", self.scene.width + 2 * RIM_CELLS, self.scene.height + 2 * RIM_CELLS),
            ("windows", wide, self.scene.window[0]),
        ):
            form = rr.components.ImageFormat(
                width=width, height=height, channel_datatype=rr.ChannelDatatype.U8
            )
            self._static(entity, rr.SegmentationImage.from_fields(format=form))

    def at(self, *, step: int, episode: int) -> None:
        """Says when it is, for what is logged next without a step of its own."""
        self._now = step, episode

    def log_scalar(self, name: str, value: Any, step: int | None = None, **kwargs: Any) -> None:
        """Logs a number, or a list, array or tensor of them as name/0, name/1 and so on."""
        if isinstance(value, Tensor | np.ndarray | list | tuple):
            numbers = np.asarray(value.detach().cpu() if isinstance(value, Tensor) else value).reshape(-1)
            if numbers.size != 1:
                for index, number in enumerate(numbers):
                    self.log_scalar(f"{name}/{index}", float(number), step)
                return
            value = numbers[0]
        when = self._now[0] if step is None else int(step)
        row = when, self._now[1], self._frames, float(value)
        for waiting in self._waiting.values():
            waiting.setdefault(name, []).append(row)
        self._send_if_due()

    def log_frames(self, frames: Mapping[str, NDArray[Any]]) -> None:
        """Logs what `FrameBuffer.take` gave: the board, agents, headings and windows of each step."""
        import rerun as rr

        if self.scene is None:
            raise ValueError("the logger has no scene; give it one to log frames")
        count = len(frames["step"])
        if not count:
            return
        numbers = np.arange(self._frames, self._frames + count)
        self._frames += count
        times = _times(frames["step"], frames["episode"], numbers)
        agents = len(self.scene.agents)
        places = np.stack([frames["col"], frames["row"]], -1).reshape(-1, 2) + RIM_CELLS + 0.5
        colours = np.array([agent_colour(agent) for agent in range(agents)], np.uint8)
        colours = np.concatenate(
            [np.tile(colours, (count, 1)), np.full((count * agents, 1), 255, np.uint8)], 1
        )
        colours[~frames["in_play"].reshape(-1), 3] = _OUT_OF_PLAY_ALPHA
        ahead = np.array([(0, -1), (1, 0), (0, 1), (-1, 0)], np.float32) * _ARROW_CELLS
        names = list(self.scene.agents) * count
        each = [agents] * count
        columns = {
            "world/board": rr.SegmentationImage.columns(
                buffer=board_with_rim(frames["board"]).reshape(count, -1)
            ),
            "windows": rr.SegmentationImage.columns(buffer=mosaic(frames["windows"]).reshape(count, -1)),
            "world/agents": rr.Points2D.columns(
                positions=places, colors=colours, radii=[AGENT_RADIUS_CELLS] * len(places), labels=names
            ).partition(each),
            "world/headings": rr.Arrows2D.columns(
                origins=places,
                vectors=ahead[frames["heading"].reshape(-1)],
                colors=[(255, 255, 255)] * len(places),
            ).partition(each),
        }
        for entity, what in columns.items():
            self._send(entity, times, what)

    def log_text(self, text: str, level: str = "INFO") -> None:
        """Logs an event at the time that `at` said."""
        import rerun as rr

        times = _times([self._now[0]], [self._now[1]], [self._frames])
        what = rr.TextLog.columns(text=[text], level=[level])
        self._send("log", times, what)

    def log_hparams(self, cfg: Any) -> None:
        """Shows a mapping, or a Markdown text, as the recipe of the run."""
        import rerun as rr

        text = (
            cfg
            if isinstance(cfg, str)
            else "\n".join(f"- **{key}**: {value}" for key, value in dict(cfg).items())
        )
        self._static("recipe", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))

    def log_video(self, name: str, video: Tensor, step: int | None = None, **kwargs: Any) -> None:
        """Logs uint8 [(1), T, C, H, W] as T images, one each `step` from the one given."""
        import rerun as rr

        clip = torch.as_tensor(video).cpu()
        clip = clip[0] if clip.ndim == 5 else clip
        if clip.ndim != 4:
            raise ValueError(f"the video is {list(video.shape)}; [T, C, H, W] or [1, T, C, H, W] is wanted")
        images = clip.permute(0, 2, 3, 1).to(torch.uint8).numpy()
        first = self._now[0] if step is None else int(step)
        form = rr.components.ImageFormat(
            width=images.shape[2],
            height=images.shape[1],
            color_model="L" if images.shape[3] == 1 else "RGB",
            channel_datatype=rr.ChannelDatatype.U8,
        )
        self._static(name, rr.Image.from_fields(format=form))
        count = len(images)
        times = _times(range(first, first + count), [self._now[1]] * count, [self._frames] * count)
        what = rr.Image.columns(buffer=np.ascontiguousarray(images).reshape(count, -1))
        self._send(name, times, what)

    def log_histogram(
        self, name: str, data: Any, *, bins: int = 30, step: int | None = None, **kwargs: Any
    ) -> None:
        """Logs how often values fall into so many equal bins, as bars."""
        import rerun as rr

        values = np.asarray(data.detach().cpu() if isinstance(data, Tensor) else data).reshape(-1)
        counts, edges = np.histogram(values, bins=bins)
        when = self._now[0] if step is None else int(step)

        def log(recording: Any) -> None:
            for timeline, number in (("step", when), ("episode", self._now[1]), ("frame", self._frames)):
                recording.set_time(timeline, sequence=number)
            recording.log(name, rr.BarChart(counts, abscissa=(edges[:-1] + edges[1:]) / 2))
            recording.reset_time()

        self._all(log)

    def _send_if_due(self) -> None:
        now = time.perf_counter()
        for each in self._streams:
            period = _FILE_PERIOD_S if each.name == "file" else _LIVE_PERIOD_S
            if now - self._sent[each.name] > period:
                self._send_waiting(each)

    def _send_waiting(self, each: _Stream) -> None:
        """Sends what one stream still waits for, one chunk an entity."""
        import rerun as rr

        waiting, self._waiting[each.name] = self._waiting[each.name], {}
        self._sent[each.name] = time.perf_counter()

        def send(recording: Any) -> None:
            for name, rows in waiting.items():
                steps, episodes, frames, values = zip(*rows, strict=True)
                recording.send_columns(
                    name, _times(steps, episodes, frames), rr.Scalars.columns(scalars=values)
                )
            recording.flush(timeout_sec=_FLUSH_TIMEOUT_S)

        each.do(send)

    def flush(self) -> None:
        """Sends everything that waits, to the file and to the viewer."""
        for each in self._streams:
            self._send_waiting(each)

    def shutdown(self) -> None:
        """Sends everything and closes the recording; the file gets its footer. A second call does nothing."""
        self.flush()
        self._all(lambda recording: recording.disconnect())
        for each in self._streams:
            each.recording = None

    close = shutdown

    def __enter__(self) -> "RerunLogger":
        return self

    def __exit__(self, *error: object) -> None:
        self.shutdown()

    def __repr__(self) -> str:
        return f"RerunLogger(exp_name={self.exp_name!r}, path={str(self.path)!r}, addresses={self.addresses})"


def _times(steps: Numbers, episodes: Numbers, frames: Numbers) -> list[Any]:
    """The timelines that every row carries."""
    import rerun as rr

    named = (("step", steps), ("episode", episodes), ("frame", frames))
    return [rr.TimeColumn(name, sequence=np.asarray(numbers, np.int64)) for name, numbers in named]


def _free_port() -> int:
    """A port of 127.0.0.1 that nobody listens at."""
    with socket.socket() as probe:
        probe.bind((LOCALHOST, 0))
        return int(probe.getsockname()[1])


def viewer() -> str:
    """How to start Rerun's own viewer: the one beside this Python, if there is one."""
    beside = Path(sys.executable).with_name("rerun")
    return str(beside) if beside.exists() else "rerun"


def _addresses(grpc: str) -> dict[str, str]:
    """Starts the web viewer's pages, and tells where to look."""
    import rerun as rr

    web = _free_port()
    rr.serve_web_viewer(web_port=web, open_browser=False)
    query = f"url={quote(grpc, safe='')}&renderer=webgl&persist=0&hide_welcome_screen=1&theme=dark"
    return {"browser": f"http://{LOCALHOST}:{web}/?{query}", "native": f"{viewer()} --connect {grpc}"}
