"""LoggerCallback: writes the metrics of each episode to a TorchRL logger, e.g. TensorBoard or W&B."""

import time
import uuid
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from tensordict import TensorDictBase
from torchrl.record.loggers import CSVLogger, Logger, get_logger

from cprl.measuring.episodes import Episode
from cprl.measuring.series import Series, Values, mean_of, numbers_of

PACKAGES: Final = ("tensorboard", "wandb")
"""The loggers that have a name, which is that of the package that each needs."""
FOLDER: Final = "logs"
"""The folder of named loggers in the run's directory."""


def check_logger(logger: object) -> None:
    """Check the name of a logger before anything is written.

    Args:
        logger: a name in `PACKAGES`; other objects are not checked.
    """
    if not isinstance(logger, str):
        return
    if logger not in PACKAGES:
        names = ", ".join(f'"{name}"' for name in PACKAGES)
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
        logger: one of `PACKAGES`, or a logger.
    """
    if not isinstance(logger, str):
        return logger
    check_logger(logger)
    folder = Path(run) / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    name, options = logger, dict[str, Any]()
    if logger == "wandb":
        name, options = Path(run).resolve().name, {"wandb_kwargs": {"id": _wandb_id(folder)}}
    made: Logger = get_logger(logger, str(folder), name, **options)
    return made


def _wandb_id(folder: Path) -> str:
    path = folder / "wandb_id.txt"
    if not path.exists():
        path.write_text(uuid.uuid4().hex[:8], encoding="utf-8")
    return path.read_text(encoding="utf-8")


def _last_step_in(logger: Logger, name: str) -> int:
    """Return the last step that the file of a CSVLogger has of a number; -1 if none, or of another logger."""
    if not isinstance(logger, CSVLogger):
        return -1
    path = Path(logger.experiment.log_dir, "scalars", f"{name}.csv")
    lines = path.read_text(encoding="utf-8").split() if path.is_file() else []
    step = lines[-1].partition(",")[0] if lines else ""
    return int(step) if step.isdecimal() else -1


class LoggerCallback:
    """Writes the numbers of each episode to a TorchRL logger, by the names of docs/metrics.md.

    A callback of `cprl.training`, and a context manager. The step of every number is the episode, counted
    from 0; of replicas in W worlds every W episodes are written together. An episode is written once all
    replicas have ended it: the mean over replicas as
    `social/equality`, and with several replicas the metrics and returns of each as
    `replica_0/social/equality`. Undefined values are not written, nor metrics that the game does not report,
    see `cprl.measuring.registry`.

    After a resume, the episodes after the checkpoint are played again, with the same steps. TorchRL's
    CSVLogger does not get those that its files have; other loggers get them again.

    Args:
        logger: any TorchRL logger, see `make_logger`. It is flushed at each checkpoint, and closed when the
            block ends, also by an error.
        replicas: the number of replicas R; by default that of the training, and 1 outside of one.
        worlds: the worlds W of each, likewise; a turn of them is W steps.
        agents: the names of the agents; by default agent_0 and so on.
        resumes: whether an earlier process may have written episodes of the same training.
    """

    is_extendable = True

    def __init__(
        self,
        logger: Logger,
        *,
        replicas: int | None = None,
        worlds: int | None = None,
        agents: Sequence[str] | None = None,
        resumes: bool = False,
    ) -> None:
        for method in ("log_metrics", "flush", "shutdown"):
            if not callable(getattr(logger, method, None)):
                kind = type(logger).__name__
                raise TypeError(f"logger is a {kind} without {method}; allowed: a TorchRL logger")
        self.logger = logger
        self._agents = agents
        self._resumes = resumes
        self._given = {"replicas": replicas, "worlds": worlds}
        self._series = Series(replicas or 1, worlds or 1)
        self._last: dict[str, int] = {}
        """The last step that the logger has of each number, where it resumes."""
        self._steps, self._steps_then, self._then = 0, 0, time.perf_counter()

    def on_start(self, training: Any) -> None:
        """Take the numbers of replicas and worlds from the training; others are refused."""
        for name, given in self._given.items():
            number = getattr(training, name)
            if given not in (None, number):
                raise ValueError(
                    f"LoggerCallback has {name}={given}, and the training has {number}; leave it out"
                )
            setattr(self._series, name, number)

    def on_step(self, batch: TensorDictBase) -> None:
        """Count the environment steps of each replica."""
        self._steps += self._series.worlds

    def on_episode(self, episode: Episode, learning: Mapping[str, float]) -> None:
        """Write the numbers of an episode once all replicas have ended it."""
        agents = self._agents or [f"agent_{agent}" for agent in range(len(episode.return_))]
        numbers = numbers_of(episode, learning, agents)
        by_replica = self._series.add(episode, numbers)
        if by_replica is not None:
            self._log(episode.episode, by_replica)

    def _log(self, episode: int, by_replica: Mapping[str, Values]) -> None:
        written = {name: mean_of(values) for name, values in by_replica.items()}
        if self._series.replicas > 1:
            for name, values in by_replica.items():
                if name.startswith(("social/", "institutions/")) or name.endswith("/return"):
                    for replica, value in enumerate(values):
                        written[f"replica_{replica}/{name}"] = float(value)
        if self._steps:
            now, steps = time.perf_counter(), (self._steps - self._steps_then) * self._series.replicas
            written["time/env_steps"] = float(self._steps)
            written["time/env_steps_per_s"] = steps / (now - self._then)
            self._then, self._steps_then = now, self._steps
        defined = {name: value for name, value in written.items() if not np.isnan(value)}
        if self._resumes:
            defined = {name: value for name, value in defined.items() if episode > self._last_step(name)}
        if defined:
            self.logger.log_metrics(defined, step=episode)

    def _last_step(self, name: str) -> int:
        if name not in self._last:
            self._last[name] = _last_step_in(self.logger, name)
        return self._last[name]

    def state_dict(self) -> dict[str, Any]:
        """The number of steps and episodes; flushes the logger first."""
        self.logger.flush()
        return {"steps": self._steps, "series": self._series.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self._resumes = True
        self._steps = self._steps_then = int(state["steps"])
        self._then = time.perf_counter()
        self._series.load_state_dict(state["series"])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: object, traceback: object) -> None:
        self.logger.flush()
        self.logger.shutdown()
