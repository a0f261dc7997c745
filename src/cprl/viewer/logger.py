"""RerunLogger: records a run with Rerun, to a file and, on request, live on 127.0.0.1."""

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
from cprl.runs.recipe import RECIPE_FILE
from cprl.system.compat import end_recordings
from cprl.system.output import console, legible
from cprl.values import shown
from cprl.viewer.board import Frames, columns
from cprl.viewer.layout import fixed, layout
from cprl.viewer.live import FLUSH_TIMEOUT_S, REPLAY, RUN, Live, LiveStream, Stream, open_file
from cprl.viewer.page import FILE_NAME
from cprl.viewer.scene import Curves, Scene

TIMELINES: Final = ("step", "episode", "frame")
"""The timelines of every row: environment steps of the run, episodes, and frames recorded so far."""

_LIVE_PERIOD_S: Final = 4.0
"""Sending a dozen numbers takes some ten milliseconds, in which a training waits for Python's lock."""
_FILE_PERIOD_S: Final = 60.0
"""Each batch of numbers adds about forty kilobytes to the file, however few they are."""
_LONGEST: Final = 90
"""Characters of a value in the table; the recipe of the run has them all."""

Numbers: TypeAlias = "Sequence[int] | NDArray[np.integer[Any]]"


def recording_id(run: Path, file_name: str) -> str | None:
    """Return the id of a recording, the same when a run is resumed or extended; None without a run."""
    if not (run / RECIPE_FILE).exists():
        return None
    recipe = read_json(run / RECIPE_FILE)
    same = {name: value for name, value in recipe.items() if name not in ("experiment", "extended")}
    return str(uuid.uuid5(uuid.NAMESPACE_URL, file_name + json.dumps(same, sort_keys=True)))


def as_table(recipe: Mapping[Any, Any]) -> str:
    """Return a recipe as a table; texts of several lines, such as drawn boards, stand below it as they are.

    An entry of a list that equals the first is one row that says so.
    """
    rows = []
    texts = []
    for place, value in _places(recipe, ""):
        if isinstance(value, str) and "\n" in value:
            texts.append(f"`{place}`\n\n```\n{value}\n```")
        else:
            rows.append(f"| {_cell(place)} | {_cell(_short(value))} |")
    return "\n\n".join(["\n".join(["| place | value |", "| --- | --- |", *rows]), *texts])


def _places(value: Any, place: str) -> Iterator[tuple[str, Any]]:
    """Each value that holds no others, with its dotted place."""
    if isinstance(value, Mapping) and value:
        for name, entry in value.items():
            yield from _places(entry, f"{place}.{name}" if place else str(name))
    elif isinstance(value, list | tuple) and any(isinstance(entry, Mapping) for entry in value):
        for index, entry in enumerate(value):
            if index and entry == value[0]:
                yield f"{place}.{index}", f"as {place}.0"
            else:
                yield from _places(entry, f"{place}.{index}")
    else:
        yield place, value


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else shown(value)
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]} ..."


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def times(steps: Numbers, episodes: Numbers, frames: Numbers) -> list[Any]:
    """Return the timelines of each row."""
    return [
        rr.TimeColumn(name, sequence=np.asarray(numbers, np.int64))
        for name, numbers in zip(TIMELINES, (steps, episodes, frames), strict=True)
    ]


def send_waiting(stream: Stream) -> None:
    """Send the buffered numbers and texts of one stream, one chunk per entity.

    Of texts viewers get the newest alone, by `LiveStream.say`. Files keep each with its time: of static texts
    in several files of one recording a viewer shows the one that it loads last.
    """
    waiting = stream.take()

    def send(recording: Any) -> None:
        known: dict[Any, list[Any]] = {}  # most names have the same times
        for name, rows in waiting.items():
            *at, values = zip(*rows, strict=True)
            if isinstance(stream, LiveStream) and isinstance(values[-1], str):
                stream.say(recording, name, values[-1])
                continue
            if tuple(at) not in known:
                known[tuple(at)] = times(*at)
            if isinstance(values[0], str):
                what: Any = rr.TextDocument.columns(text=list(values))
            else:
                lines = [len(line) for line in values]
                what = rr.Scalars.columns(scalars=np.concatenate(values)).partition(lines)
            recording.send_columns(name, known[tuple(at)], what)
        recording.flush(timeout_sec=FLUSH_TIMEOUT_S)

    stream.do(send)


class RerunLogger(Logger):
    """A TorchRL logger that writes a Rerun recording; names become entities, `social/equality` and so on.

    Numbers are buffered in memory and sent as columns: to viewers about every four seconds, to the file about
    every minute. Every row carries the timelines `step` (environment steps of the run), `episode` and `frame`
    (frames recorded so far). The file and the live recording are two streams with the same recording id. If
    one fails, the logger warns once, drops it and continues with the other.

    Args:
        curves: the numbers that are plotted; a `Scene` if there is a board.
        live: "serve" or "spawn", see `cprl.viewer.live.Live`; None for the file alone. The recording and the
            page of the web viewer are served on 127.0.0.1 only.
        exhibits: whether viewers are sent an exhibition too, see `cprl.viewer.exhibition`.
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
        file_name: str = FILE_NAME,
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
        """What viewers are sent; None where the recording is written to a file alone."""
        self._live = live
        self._exhibits = exhibits
        self._streams: list[Stream] = []
        self.frames = 0
        """Frames recorded so far, including those in earlier files of the recording."""
        self.step = self.episode = 0
        """The time of what is logged; see `at`."""
        self._clips_end: dict[str, int] = {}
        super().__init__(exp_name, str(log_dir))

    def _create_experiment(self) -> list[Any]:
        Path(self.log_dir).mkdir(parents=True, exist_ok=True)
        application = REPLAY if self.scene is not None and self.scene.is_replay else RUN
        file = open_file(
            self.recording_id,
            self.path,
            layout(self.curves),
            period_s=_FILE_PERIOD_S,
            application=application,
        )
        self._streams = [] if file is None else [file]
        if self._live:
            self.live = Live(
                self._live,
                self.recording_id,
                layout(self.curves, live=True),
                period_s=_LIVE_PERIOD_S,
                application=application,
                exhibits=self._exhibits,
            )
            self._streams.append(self.live.stream)
            for where, address in self.addresses.items():
                console().print(f"Watch live ({where}): {address}", soft_wrap=True, highlight=False)
        self.do(lambda recording: recording.send_recording_name(self.exp_name))
        for entity, parts in fixed(self.curves).items():
            self.log_static(entity, *parts)
        self.do(lambda recording: recording.flush(timeout_sec=FLUSH_TIMEOUT_S))
        return [stream.recording for stream in self._streams]

    @property
    def scene(self) -> Scene | None:
        """The board that is shown, if there is one."""
        return self.curves if isinstance(self.curves, Scene) else None

    @property
    def addresses(self) -> dict[str, str]:
        """How to watch live: "browser" and "native"."""
        return {} if self.live is None else self.live.addresses

    @property
    def is_live(self) -> bool:
        """Whether viewers can connect: the live stream is open and served."""
        return self.live is not None and self.live.stream.is_open

    @property
    def turn(self) -> int:
        """The turn of what is logged."""
        return self.step // self.curves.worlds

    def do(self, what: Callable[[Any], object], *, live_only: bool = False) -> None:
        """Call a function with each recording, or with that to viewers alone, in the thread that sends."""
        for stream in self._streams:
            if stream.is_live or not live_only:
                stream.do(what)

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
        """Send buffered numbers and texts to whom they are due; all that is logged between two calls is sent
        together, so that it agrees when it is seen."""
        for stream in self._streams:
            if stream.is_due:
                send_waiting(stream)

    def log_static(self, entity: str, *what: Any) -> None:
        """Log archetypes that hold at all times."""
        self.do(lambda recording: recording.log(entity, *what, static=True))

    def log_row(self, name: str, what: Any, *, step: int | None = None, live_only: bool = False) -> None:
        """Log an archetype at the time set by `at`, or at another step."""
        at = self.step if step is None else step, self.episode, self.frames

        def log(recording: Any) -> None:
            for timeline, number in zip(TIMELINES, at, strict=True):
                recording.set_time(timeline, sequence=number)
            recording.log(name, what)
            recording.reset_time()

        self.do(log, live_only=live_only)

    def log_columns(
        self, name: str, at: tuple[Numbers, Numbers, Numbers], what: Any, *, live_only: bool = False
    ) -> None:
        """Log rows at steps, episodes and frames of their own."""
        columns = times(*at)
        self.do(lambda recording: recording.send_columns(name, columns, what), live_only=live_only)

    def at(self, *, step: int, episode: int) -> None:
        """Set the time of subsequent logs that have no step of their own."""
        self.step = step
        self.episode = episode

    def log_scalar(self, name: str, value: Any, step: int | None = None, **kwargs: Any) -> None:
        """Log a number, or a list, array or tensor of numbers as name/0, name/1 and so on."""
        numbers = _numbers_in(value)
        for index, number in enumerate(numbers.tolist()):
            entity = name if numbers.size == 1 else f"{name}/{index}"
            self._wait(entity, self.step if step is None else int(step), [float(number)])
        self.send_due()

    def log_lines(self, name: str, values: Sequence[float]) -> None:
        """Log the numbers of several lines of one plot, equally many each time; NaN leaves a gap. They are
        sent when they are due, see `send_due`."""
        self._wait(name, self.step, [float(value) for value in values])

    def log_document(self, name: str, text: str) -> None:
        """Log a Markdown text in place of the one before, live at all times; it is sent with the numbers."""
        self._wait(name, self.step, text)

    def show_live(self, name: str, text: str) -> None:
        """`log_document` in the live view alone, and at once; from any thread."""
        for stream in self._streams:
            if isinstance(stream, LiveStream):
                stream.do(partial(stream.say, name=name, text=text))

    def _wait(self, name: str, step: int, values: list[float] | str) -> None:
        for stream in self._streams:
            stream.waiting.setdefault(name, []).append((step, self.episode, self.frames, values))

    def log_frames(self, frames: Frames) -> None:
        """Log frames of `FrameRecorder.take`; see `cprl.viewer.board.columns`."""
        if self.scene is None:
            raise ValueError("the logger has no scene; pass a Scene as curves to log frames")
        numbers = np.arange(self.frames, self.frames + len(frames["step"]))
        self.frames += len(numbers)
        for entity, (rows, what) in columns(self.scene, frames).items():
            self.log_columns(entity, (frames["step"][rows], frames["episode"][rows], numbers[rows]), what)

    def log_text(self, text: str) -> None:
        self.log_row("log", rr.TextLog(text, level="INFO"))

    def log_hparams(self, cfg: Any) -> None:
        """Log a mapping, as a table, or a Markdown text, as the recipe of the run."""
        text = cfg if isinstance(cfg, str) else as_table(dict(cfg))
        self.log_static("recipe", rr.TextDocument(legible(text), media_type=rr.MediaType.MARKDOWN))

    def log_video(self, name: str, video: Tensor, step: int | None = None, **kwargs: Any) -> None:
        """Log uint8 [(1), T, C, H, W] as T images at consecutive steps from `step` on.

        Starts after the last image of an earlier clip with the same name, because TorchRL's recorders pass
        the number of the clip as its step.
        """
        clip = torch.as_tensor(video).cpu()
        clip = clip[0] if clip.ndim == 5 else clip
        if clip.ndim != 4:
            raise ValueError(f"the video is {list(video.shape)}; allowed: [T, C, H, W] or [1, T, C, H, W]")
        first = max(self.step if step is None else int(step), self._clips_end.get(name, 0))
        self._clips_end[name] = first + len(clip)
        for number, image in enumerate(clip.permute(0, 2, 3, 1).to(torch.uint8).numpy(), start=first):
            self.log_row(name, rr.Image(image), step=number)

    def log_histogram(
        self, name: str, data: Any, *, bins: int = 30, step: int | None = None, **kwargs: Any
    ) -> None:
        """Log a histogram of values in equal bins, as bars."""
        counts, edges = np.histogram(_numbers_in(data), bins=bins)
        self.log_row(name, rr.BarChart(counts, abscissa=(edges[:-1] + edges[1:]) / 2), step=step)

    def flush(self) -> None:
        """Send all buffered numbers to the file and to the viewer."""
        for stream in self._streams:
            send_waiting(stream)

    def close_file(self) -> None:
        """Flush and close the file, which gets its footer; the live stream goes on."""
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
        if not any(stream.has_failed for stream in self._streams):  # the end of one would wait for its viewer
            self._streams.clear()
            with suppress(RuntimeError):  # of an earlier recording that failed, which was reported then
                end_recordings()

    close = shutdown

    def __enter__(self) -> "RerunLogger":
        return self

    def __exit__(self, *error: object) -> None:
        self.shutdown()

    def __repr__(self) -> str:
        return f"RerunLogger(exp_name={self.exp_name!r}, path={str(self.path)!r}, addresses={self.addresses})"


def _numbers_in(data: Any) -> NDArray[Any]:
    return np.asarray(data.detach().cpu() if isinstance(data, Tensor) else data).reshape(-1)
