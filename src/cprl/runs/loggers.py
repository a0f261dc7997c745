"""Log the metrics of each episode to a TorchRL logger, e.g. TensorBoard or W&B."""

import uuid
from collections.abc import Mapping
from importlib.util import find_spec
from math import isnan
from pathlib import Path
from typing import Any, Final, Self

from torchrl.record.loggers import CSVLogger, Logger, get_logger

from cprl.measuring.series import GROUP_PREFIXES, mean_of
from cprl.values.array_types import Float64

LOGGER_PACKAGES: Final = ("tensorboard", "wandb")
"""The loggers that can be named, each by the package that it needs."""
LOGS: Final = "logs"
"""The folder of named loggers in the run's directory."""


def check_logger(logger: object) -> None:
    """Check the name of a logger before anything is written.

    Args:
        logger: a name in `LOGGER_PACKAGES`; other objects are not checked.

    Raises:
        ValueError: for another name.
        ModuleNotFoundError: if its package is not installed.
    """
    if not isinstance(logger, str):
        return
    if logger not in LOGGER_PACKAGES:
        names = ", ".join(f'"{name}"' for name in LOGGER_PACKAGES)
        raise ValueError(f"logger is {logger!r}; allowed: {names}, or a TorchRL logger")
    if find_spec(logger) is None:
        raise ModuleNotFoundError(
            f'logger is "{logger}", which needs the package {logger}: pip install {logger}', name=logger
        )


def make_logger(logger: str | Logger, run: str | Path) -> Logger:
    """Make a TorchRL logger by its name; a logger is returned as it is.

    "tensorboard" writes to `logs/tensorboard`; "wandb" to `logs/wandb` and to a W&B run with the name of the
    directory, which a resumed run continues. The environment variables `WANDB_PROJECT` and `WANDB_MODE` set
    the project and whether W&B is online.

    Args:
        logger: one of `LOGGER_PACKAGES`, or a logger.
    """
    if not isinstance(logger, str):
        return logger
    check_logger(logger)
    folder = Path(run) / LOGS
    folder.mkdir(parents=True, exist_ok=True)
    name = logger
    options = dict[str, Any]()
    if logger == "wandb":
        name = Path(run).resolve().name
        options = {"wandb_kwargs": {"id": _wandb_id(folder)}}
    named: Logger = get_logger(logger, str(folder), name, **options)
    return named


def _wandb_id(folder: Path) -> str:
    path = folder / "wandb_id.txt"
    if not path.exists():
        path.write_text(uuid.uuid4().hex[:8], encoding="utf-8")
    return path.read_text(encoding="utf-8")


def _last_step_in(logger: Logger, name: str) -> int:
    """Return the last step of a number in the file of a CSVLogger; -1 without one, and for other loggers."""
    if not isinstance(logger, CSVLogger):
        return -1
    path = Path(logger.experiment.log_dir, "scalars", f"{name}.csv")
    lines = path.read_text(encoding="utf-8").split() if path.is_file() else []
    step = lines[-1].partition(",")[0] if lines else ""
    return int(step) if step.isdecimal() else -1


class LoggerCallback:
    """A callback of `cprl.training` that writes the numbers of each episode to a TorchRL logger.

    It is a context manager, and uses the names of docs/metrics.md. The step of every number is the episode,
    counted from 0; with W worlds, every W episodes are written together. An episode is written once all
    replicas have ended it: the mean over replicas as `social/equality`, and with several replicas the metrics
    and returns of each as `replica_0/social/equality`. Undefined values are not written, nor metrics that the
    game does not report.

    After a resume, the episodes after the checkpoint are played again, with the same steps. TorchRL's
    CSVLogger does not get those that its files have; other loggers get them again.

    Args:
        logger: any TorchRL logger, see `make_logger`. It is flushed at each checkpoint, and closed when the
            block ends, also by an error.
        resumes: whether an earlier process may have written episodes of the same training.
    """

    def __init__(self, logger: Logger, *, resumes: bool = False) -> None:
        for method in ("log_metrics", "flush", "shutdown"):
            if not callable(getattr(logger, method, None)):
                kind = type(logger).__name__
                raise TypeError(f"logger is a {kind} without {method}; allowed: a TorchRL logger")
        self.logger = logger
        self._resumes = resumes
        self._last: dict[str, int] = {}
        """The last logged step of each number, if it resumes."""

    def on_numbers(self, episode: int, numbers: Mapping[str, Float64]) -> None:
        """Write the numbers of an episode that all replicas have ended."""
        written = {name: mean_of(values) for name, values in numbers.items()}
        for name, values in numbers.items():
            if len(values) > 1 and (name.startswith(GROUP_PREFIXES) or name.endswith("/return")):
                for replica, value in enumerate(values.tolist()):
                    written[f"replica_{replica}/{name}"] = value
        defined = {name: value for name, value in written.items() if not isnan(value)}
        if self._resumes:
            defined = {name: value for name, value in defined.items() if episode > self._last_step(name)}
        if defined:
            self.logger.log_metrics(defined, step=episode)

    def _last_step(self, name: str) -> int:
        if name not in self._last:
            self._last[name] = _last_step_in(self.logger, name)
        return self._last[name]

    def state_dict(self) -> dict[str, Any]:
        """Flush the logger; there is nothing else to keep."""
        self.logger.flush()
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self._resumes = True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.logger.flush()
        self.logger.shutdown()
