"""LoggerCallback: writes the metrics of each episode to a TorchRL logger, e.g. CSV, TensorBoard or W&B."""

import time
import uuid
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import numpy as np
from tensordict import TensorDictBase
from torchrl.record.loggers import CSVLogger, Logger, get_logger

from cprl.measuring.episodes import Episode
from cprl.measuring.series import Series, Values, mean_of, numbers_of

PACKAGES: Final[Mapping[str, str | None]] = {"csv": None, "tensorboard": "tensorboard", "wandb": "wandb"}
"""The loggers that have a name, and the package that each needs."""
FOLDER: Final = "logs"
"""The folder of named loggers in the run's directory."""

_MOST_OPEN_FILES: Final = 200
"""TorchRL's CSV logger holds one open file per name; above this number they are closed after each episode."""


def check_logger(logger: object) -> None:
    """Checks the name of a logger; call it before anything is written.

    Args:
        logger: a name in `PACKAGES`; other objects are not checked.

    Raises:
        ValueError: if the name is unknown.
        ModuleNotFoundError: if its package is not installed; says what to install.
    """
    if not isinstance(logger, str):
        return
    if logger not in PACKAGES:
        names = ", ".join(f'"{name}"' for name in PACKAGES)
        raise ValueError(f"logger is {logger!r}; allowed: {names}, or a TorchRL logger")
    package = PACKAGES[logger]
    if package is not None and find_spec(package) is None:
        raise ModuleNotFoundError(
            f'logger is "{logger}", which needs the package {package}: pip install {package}', name=package
        )


def make_logger(logger: str | Logger, run: str | Path) -> Logger:
    """Makes a TorchRL logger by its name; a logger is returned as it is.

    "csv" writes a file for each name, `logs/csv/scalars/<name>.csv` of the run with lines `step,value`;
    "tensorboard" writes to `logs/tensorboard`; "wandb" to `logs/wandb` and to a W&B run with the name of the
    directory, which a resumed run continues. The environment variables `WANDB_PROJECT` and `WANDB_MODE` set
    the project and whether W&B is online.

    Args:
        logger: one of `PACKAGES`, or a logger.
        run: the run's directory.

    Raises:
        ValueError, ModuleNotFoundError: see `check_logger`.
    """
    if not isinstance(logger, str):
        return logger
    check_logger(logger)
    folder = Path(run) / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    if logger == "csv":
        return _RunCSVLogger(exp_name="csv", log_dir=str(folder))
    if logger == "tensorboard":
        made: Logger = get_logger("tensorboard", str(folder), "tensorboard")
        return made
    name = Path(run).resolve().name
    made = get_logger("wandb", str(folder), name, wandb_kwargs={"id": _wandb_id(folder)})
    return made


class LoggerCallback:
    """Writes the numbers of each episode to a TorchRL logger, by the names of docs/metrics.md.

    A callback of `cprl.training`, and a context manager. The step of every number is the episode, counted
    from 0. An episode is written once all replicas have ended it: the mean over replicas as
    `social/equality`, and with several replicas the metrics and returns of each as
    `replica_0/social/equality`. Undefined values are not written, nor metrics that the game does not report,
    see `cprl.measuring.reported`.

    After a resume, the files of a CSV logger are truncated to their state at the checkpoint. Other loggers
    cannot remove values: they get the episodes after the checkpoint again, with the same steps.

    Args:
        logger: any TorchRL logger, see `make_logger`. It is flushed at each checkpoint, and closed when the
            block ends, also by an error.
        replicas: the number of replicas R.
        agents: the names of the agents; by default agent_0 and so on.

    Raises:
        TypeError: if `logger` is not a logger.
    """

    def __init__(self, logger: Logger, *, replicas: int = 1, agents: Sequence[str] | None = None) -> None:
        for method in ("log_metrics", "flush", "shutdown"):
            if not callable(getattr(logger, method, None)):
                kind = type(logger).__name__
                raise TypeError(f"logger is a {kind} without {method}; allowed: a TorchRL logger")
        self.logger = logger
        self._agents, self._series = agents, Series(replicas)
        self._steps, self._steps_then, self._then = 0, 0, time.perf_counter()
        self._is_placed = not isinstance(logger, _RunCSVLogger)

    def on_step(self, batch: TensorDictBase) -> None:
        """Counts the environment steps of each replica."""
        self._steps += 1 if batch.batch_dims == 1 else batch.batch_size[1]

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        """Writes the numbers of an episode once all replicas have ended it."""
        agents = self._agents or [f"agent_{agent}" for agent in range(len(episode.return_))]
        numbers = numbers_of(episode, learning, agents)
        of_all = self._series.add(episode.episode, episode.world, numbers)
        if of_all is not None:
            self._log(episode.episode, of_all)

    def _log(self, episode: int, of_all: Mapping[str, Values]) -> None:
        if not self._is_placed:  # there is no checkpoint of the last attempt: start over
            self._rewind({})
        written = {name: mean_of(values) for name, values in of_all.items()}
        if self._series.replicas > 1:
            for name, values in of_all.items():
                if name.startswith(("social/", "institutions/")) or name.endswith("/return"):
                    written |= {f"replica_{nth}/{name}": float(value) for nth, value in enumerate(values)}
        if self._steps:
            now, steps = time.perf_counter(), (self._steps - self._steps_then) * self._series.replicas
            written["time/env_steps"] = float(self._steps)
            written["time/env_steps_per_s"] = steps / (now - self._then)
            self._then, self._steps_then = now, self._steps
        defined = {name: value for name, value in written.items() if not np.isnan(value)}
        self.logger.log_metrics(defined, step=episode)
        if isinstance(self.logger, CSVLogger) and len(self.logger.experiment.files) > _MOST_OPEN_FILES:
            _close_files(self.logger)

    def state_dict(self) -> dict[str, Any]:
        """The number of steps and episodes; flushes the logger first."""
        self.logger.flush()
        return {
            "steps": self._steps,
            "series": self._series.state_dict(),
            "files": _sizes(self.logger) if isinstance(self.logger, CSVLogger) else {},
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continues from a state; truncates the files of a CSV logger to it."""
        self._steps = self._steps_then = int(state["steps"])
        self._then = time.perf_counter()
        self._series.load_state_dict(state["series"])
        self._rewind(state["files"])

    def _rewind(self, sizes: Mapping[str, int]) -> None:
        if isinstance(self.logger, CSVLogger):
            _cut(self.logger, sizes)
        self._is_placed = True

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.logger.flush()
        if isinstance(self.logger, CSVLogger):
            _close_files(self.logger)
        self.logger.shutdown()


class _RunCSVLogger(CSVLogger):
    """A CSV logger in a run's directory, where nothing else writes: without a checkpoint it starts over."""


def _scalars(logger: CSVLogger) -> Path:
    return Path(logger.experiment.log_dir) / "scalars"


def _sizes(logger: CSVLogger) -> dict[str, int]:
    """The size of each file of scalars in bytes, by relative path; TorchRL flushes every line."""
    folder = _scalars(logger)
    return {path.relative_to(folder).as_posix(): path.stat().st_size for path in folder.rglob("*.csv")}


def _cut(logger: CSVLogger, sizes: Mapping[str, int]) -> None:
    """Truncates files to these sizes, and deletes files that are not among them."""
    _close_files(logger)
    for name, found in _sizes(logger).items():
        path = _scalars(logger) / name
        if name not in sizes:
            path.unlink()
        elif found > sizes[name]:
            with path.open("r+b") as file:
                file.truncate(sizes[name])


def _close_files(logger: CSVLogger) -> None:
    """Closes the open files of TorchRL's CSV logger; it reopens them to append."""
    files = logger.experiment.files
    for file in files.values():
        file.close()
    files.clear()


def _wandb_id(folder: Path) -> str:
    """The id of the W&B run, the same when a run is resumed."""
    path = folder / "wandb_id.txt"
    if not path.exists():
        path.write_text(uuid.uuid4().hex[:8], encoding="utf-8")
    return path.read_text(encoding="utf-8")
