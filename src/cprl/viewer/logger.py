"""RerunLogger: records a run for the Rerun viewer, in a file and, on request, live on 127.0.0.1."""

import json
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np
import rerun as rr
import torch
from numpy.typing import NDArray
from torch import Tensor
from torchrl.record.loggers import Logger

from cprl.runs.files import read_json
from cprl.runs.recipe import RECIPE_FILE, recipe_table
from cprl.system.compat.recordings import end_recordings
from cprl.system.output import console, legible
from cprl.viewer.board import Frames, frame_columns
from cprl.viewer.layout import layout, static_parts
from cprl.viewer.live import (
    FLUSH_TIMEOUT_S,
    REPLAY_APPLICATION,
    RUN_APPLICATION,
    BufferedRow,
    Live,
    LiveStream,
    Stream,
    open_file,
)
from cprl.viewer.names import HEADER
from cprl.viewer.page import RECORDING_FILE
from cprl.viewer.scene import Curves, Scene

_TIMELINES: Final = ("step", "episode", "frame")
"""The timelines of every row: environment steps of the run, episodes, and frames recorded so far."""

_LIVE_PERIOD_S: Final = 4.0
"""Seconds between two sends to viewers. A send takes about 10 ms, during which the training waits for
Python's global lock."""
_FILE_PERIOD_S: Final = 60.0
"""Seconds between two writes to the file. Each write adds about 40 kB, even for few numbers."""

_Integers: TypeAlias = "Sequence[int] | NDArray[np.integer[Any]]"
RowTimes: TypeAlias = tuple[_Integers, _Integers, _Integers]
"""The steps, the episodes and the frames of some rows: one number per row on each timeline."""


def recording_id(run: Path, file_name: str) -> str | None:
    """Return the id of a run's recording, which stays the same when the run is resumed or extended.

    Return None if the directory holds no run.
    """
    if not (run / RECIPE_FILE).exists():
        return None
    recipe = read_json(run / RECIPE_FILE)
    unchanging = {name: value for name, value in recipe.items() if name not in ("experiment", "extended")}
    return str(uuid.uuid5(uuid.NAMESPACE_URL, file_name + json.dumps(unchanging, sort_keys=True)))


def _time_columns(times: RowTimes) -> list[Any]:
    """Return Rerun's column of each timeline."""
    return [
        rr.TimeColumn(timeline, sequence=np.asarray(numbers, np.int64))
        for timeline, numbers in zip(_TIMELINES, times, strict=True)
    ]


def send_buffer(stream: Stream) -> None:
    """Send the buffered numbers and headers of one stream, one chunk per entity.

    A viewer gets only the newest header, without a time, see `LiveStream.send_header`. A file keeps each
    header with its time: if several files of one recording had one without a time, the viewer would show the
    one that it loads last.
    """
    stream.call(partial(_send_rows, stream, stream.take_buffer()))


def _send_rows(stream: Stream, rows_by_entity: Mapping[str, Sequence[BufferedRow]], recording: Any) -> None:
    time_columns: dict[Any, list[Any]] = {}  # by the times of the rows, which most entities share
    for entity, rows in rows_by_entity.items():
        steps, episodes, frames, values = zip(*rows, strict=True)
        if isinstance(stream, LiveStream) and isinstance(values[-1], str):
            stream.send_header(recording, values[-1])
            continue
        times = (steps, episodes, frames)
        if times not in time_columns:
            time_columns[times] = _time_columns(times)
        if isinstance(values[0], str):
            columns = rr.TextDocument.columns(text=values)
        else:
            columns = rr.Scalars.columns(scalars=np.concatenate(values)).partition(list(map(len, values)))
        recording.send_columns(entity, time_columns[times], columns)
    recording.flush(timeout_sec=FLUSH_TIMEOUT_S)


class RerunLogger(Logger):
    """A TorchRL logger that writes a Rerun recording. A logged name becomes an entity: `social/equality`.

    Numbers are buffered in memory and sent as columns: to viewers about every four seconds, to the file about
    every minute. Every row carries the timelines `step` (environment steps of the run), `episode` and `frame`
    (frames recorded so far). The file and the live recording are two streams with the same recording id. If
    one stream fails, the logger warns once, drops it and continues with the other.

    Args:
        curves: the numbers that are plotted; a `Scene` if the recording shows a board.
        live: "serve" or "spawn", see `cprl.viewer.live.Live`; None writes the file only. The recording and
            the page of the web viewer are served on 127.0.0.1 only.
        exhibits: whether viewers also get an exhibition, see `cprl.experimental.exhibition`.
        file_name: the name of the file in `log_dir`.
        recording_id: the viewer shows files with the same id as one recording; by default a new id.

    Raises:
        FileExistsError: if the recording exists.
    """

    def __init__(
        self,
        exp_name: str,
        log_dir: str | Path,
        *,
        curves: Curves | None = None,
        live: str | None = None,
        exhibits: bool = False,
        file_name: str = RECORDING_FILE,
        recording_id: str | None = None,
    ) -> None:
        self.curves = curves or Curves(agents=())
        self.recording_id = recording_id or f"{exp_name}-{time.time_ns()}"
        self.path = Path(log_dir) / file_name
        if self.path.exists():
            raise FileExistsError(
                f"{self.path} exists and is not overwritten; use another directory or file_name"
            )
        self.live: Live | None = None
        """The served recording; None if the recording is only written to a file."""
        self._live_mode = live
        self._exhibits = exhibits
        self._streams: list[Stream] = []
        self.frames = 0
        """Frames recorded so far, including those in earlier files of the recording."""
        self.step = self.episode = 0
        """The step and the episode of the rows that are logged next; see `set_time`."""
        self._video_ends: dict[str, int] = {}
        """The step after the last image of each logged video, by its name."""
        super().__init__(exp_name, str(log_dir))

    def _create_experiment(self) -> list[Any]:
        Path(self.log_dir).mkdir(parents=True, exist_ok=True)
        application = RUN_APPLICATION
        if self.scene is not None and self.scene.is_replay:
            application = REPLAY_APPLICATION
        file = open_file(
            self.recording_id,
            self.path,
            layout(self.curves),
            period_s=_FILE_PERIOD_S,
            application=application,
        )
        self._streams = [] if file is None else [file]
        if self._live_mode:
            self.live = Live(
                self._live_mode,
                self.recording_id,
                layout(self.curves, live=True),
                period_s=_LIVE_PERIOD_S,
                application=application,
                exhibits=self._exhibits,
            )
            self._streams.append(self.live.stream)
            for viewer, address in self.addresses.items():
                console().print(f"Watch live ({viewer}): {address}", soft_wrap=True, highlight=False)
        self.call_on_recordings(lambda recording: recording.send_recording_name(self.exp_name))
        for entity, archetypes in static_parts(self.curves).items():
            self.log_static(entity, *archetypes)
        self.call_on_recordings(lambda recording: recording.flush(timeout_sec=FLUSH_TIMEOUT_S))
        return [stream.recording for stream in self._streams]

    @property
    def scene(self) -> Scene | None:
        """Return the curves with the board that is shown; None if the recording shows no board."""
        return self.curves if isinstance(self.curves, Scene) else None

    @property
    def addresses(self) -> dict[str, str]:
        """Return the addresses of the live recording for the viewers "browser" and "native"; an empty mapping
        if the recording is not served."""
        return {} if self.live is None else self.live.addresses

    @property
    def is_live(self) -> bool:
        """Return whether viewers can connect: the live stream is open and served."""
        return self.live is not None and self.live.stream.is_open

    @property
    def turn(self) -> int:
        """Return the turn of the rows that are logged next."""
        return self.step // self.curves.worlds

    def call_on_recordings(self, function: Callable[[Any], object], *, live_only: bool = False) -> None:
        """Call a function with each `rerun.RecordingStream`; with the live one in the thread that sends.

        Args:
            live_only: leave out the recording in the file.
        """
        for stream in self._streams:
            if stream.is_live or not live_only:
                stream.call(function)

    @contextmanager
    def silent(self) -> Iterator[None]:
        """Log nothing within the block."""
        streams = self._streams
        self._streams = []
        try:
            yield
        finally:
            self._streams = streams

    def send_due(self) -> None:
        """Send the buffers of the streams whose period is over.

        Rows logged between two calls are sent together, so that a viewer never shows half an episode.
        """
        for stream in self._streams:
            if stream.is_due:
                send_buffer(stream)

    def log_static(self, entity: str, *archetypes: Any) -> None:
        """Log archetypes without a time: they hold at every step."""
        self.call_on_recordings(lambda recording: recording.log(entity, *archetypes, static=True))

    def log_row(
        self, entity: str, archetype: Any, *, step: int | None = None, live_only: bool = False
    ) -> None:
        """Log an archetype at the time of `set_time`, or at another step."""
        row_time = (self._step_or(step), self.episode, self.frames)

        def log(recording: Any) -> None:
            for timeline, number in zip(_TIMELINES, row_time, strict=True):
                recording.set_time(timeline, sequence=number)
            recording.log(entity, archetype)
            recording.reset_time()

        self.call_on_recordings(log, live_only=live_only)

    def log_columns(self, entity: str, times: RowTimes, columns: Any, *, live_only: bool = False) -> None:
        """Log several rows of an entity, each at its step, episode and frame."""
        time_columns = _time_columns(times)
        self.call_on_recordings(
            lambda recording: recording.send_columns(entity, time_columns, columns), live_only=live_only
        )

    def set_time(self, *, step: int, episode: int) -> None:
        """Set the step and the episode of the rows that are logged from now on."""
        self.step = step
        self.episode = episode

    def _step_or(self, step: int | None) -> int:
        return self.step if step is None else int(step)

    def log_scalar(self, name: str, value: Any, step: int | None = None, **kwargs: Any) -> None:
        """Log a number, or a list, array or tensor of numbers as name/0, name/1 and so on."""
        numbers = _flat_array(value)
        for index, number in enumerate(numbers.tolist()):
            entity = name if numbers.size == 1 else f"{name}/{index}"
            self._buffer(entity, self._step_or(step), [float(number)])
        self.send_due()

    def log_lines(self, name: str, values: Sequence[float]) -> None:
        """Log one number for each line of a plot, in the same order each time; NaN leaves a gap.

        They are sent with the next `send_due`.
        """
        self._buffer(name, self.step, [float(value) for value in values])

    def log_header(self, text: str) -> None:
        """Log the header, a Markdown text, which replaces the earlier one; it is sent with the buffered
        numbers."""
        self._buffer(HEADER, self.step, text)

    def show_header(self, text: str) -> None:
        """Show a header to viewers at once, without writing it to the file; from any thread."""
        for stream in self._streams:
            if isinstance(stream, LiveStream):
                stream.call(partial(stream.send_header, text=text))

    def _buffer(self, name: str, step: int, values: list[float] | str) -> None:
        for stream in self._streams:
            stream.buffer.setdefault(name, []).append((step, self.episode, self.frames, values))

    def log_frames(self, frames: Frames) -> None:
        """Log recorded frames, as `cprl.viewer.frames.FrameRecorder.take` returns them.

        Raises:
            ValueError: if the recording shows no board.
        """
        if self.scene is None:
            raise ValueError("the logger has no scene; pass a Scene as curves to log frames")
        frame_numbers = np.arange(self.frames, self.frames + len(frames["step"]))
        self.frames += len(frame_numbers)
        for entity, (rows, columns) in frame_columns(self.scene, frames).items():
            times = (frames["step"][rows], frames["episode"][rows], frame_numbers[rows])
            self.log_columns(entity, times, columns)

    def log_text(self, text: str) -> None:
        self.log_row("log", rr.TextLog(text, level="INFO"))

    def log_hparams(self, cfg: Any) -> None:
        """Log the recipe of the run: a Markdown text, or a mapping that becomes a table."""
        text = cfg if isinstance(cfg, str) else recipe_table(dict(cfg))
        self.log_static("recipe", rr.TextDocument(legible(text), media_type=rr.MediaType.MARKDOWN))

    def log_video(self, name: str, video: Tensor, step: int | None = None, **kwargs: Any) -> None:
        """Log T images, uint8 [T, C, H, W] or [1, T, C, H, W], at consecutive steps from `step` on.

        A video starts after the last image of an earlier one with the same name, because TorchRL's recorders
        pass the number of the video as its step.

        Raises:
            ValueError: for a video of another shape.
        """
        images = torch.as_tensor(video).cpu()
        images = images[0] if images.ndim == 5 else images
        if images.ndim != 4:
            raise ValueError(f"the video is {list(video.shape)}; allowed: [T, C, H, W] or [1, T, C, H, W]")
        first_step = max(self._step_or(step), self._video_ends.get(name, 0))
        self._video_ends[name] = first_step + len(images)
        channels_last = images.permute(0, 2, 3, 1).to(torch.uint8).numpy()
        for image_step, image in enumerate(channels_last, start=first_step):
            self.log_row(name, rr.Image(image), step=image_step)

    def log_histogram(
        self, name: str, data: Any, *, bins: int = 30, step: int | None = None, **kwargs: Any
    ) -> None:
        """Log a histogram of values in equal bins, as bars."""
        counts, edges = np.histogram(_flat_array(data), bins=bins)
        self.log_row(name, rr.BarChart(counts, abscissa=(edges[:-1] + edges[1:]) / 2), step=step)

    def flush(self) -> None:
        """Send all buffered numbers and headers, to the file and to viewers."""
        for stream in self._streams:
            send_buffer(stream)

    def close_file(self) -> None:
        """Flush and close the file, which gets its footer; the live stream stays open."""
        self.flush()
        for stream in self._streams:
            if not stream.is_live:
                stream.close()

    def shutdown(self) -> None:
        """Flush and close the recording; the file gets its footer. A second call does nothing."""
        self.close_file()
        if self.live is not None:
            self.live.close()
        self.experiment.clear()
        if not any(stream.has_failed for stream in self._streams):  # a failed one waits for its viewer to end
            self._streams.clear()
            with suppress(RuntimeError):  # from an earlier recording that failed and was reported then
                end_recordings()

    close = shutdown

    def __enter__(self) -> "RerunLogger":
        return self

    def __exit__(self, *error: object) -> None:
        self.shutdown()

    def __repr__(self) -> str:
        return f"RerunLogger(exp_name={self.exp_name!r}, path={str(self.path)!r}, addresses={self.addresses})"


def _flat_array(data: Any) -> NDArray[Any]:
    """Return the numbers of a tensor, an array or a list as an array of one dimension."""
    if isinstance(data, Tensor):
        data = data.detach().cpu()
    return np.asarray(data).reshape(-1)
