"""Trials: the runs of a study, one for each condition and block of replicas, each in its own directory.

The state of a study is read from these directories alone. `Trial` says which run belongs to a directory. A
trial has begun when its recipe is in the directory. From then on `cprl run DIRECTORY --resume` finishes it,
whether it holds the recipe alone or a run that was killed at any moment. `Task` runs that command, or its
equivalent in this process, and says what came of it.
"""

import json
import os
import shutil
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

from cprl.experiment import Experiment
from cprl.population import Frozen, partners_in, with_stored
from cprl.runs.checkpoints import endings_of
from cprl.runs.files import (
    LOCK_FILE,
    NEUTRAL_FIELDS,
    REPORT,
    RunLock,
    RunLockedError,
    break_hard_links,
    digest_of,
    refuse_missing,
    remove_partial,
)
from cprl.runs.length import Length, without_length
from cprl.runs.recipe import (
    changed_code,
    read_recipe,
    recipe_config,
    write_on_nan,
)
from cprl.runs.states import RunState, depends_on_episodes, start, state_of
from cprl.studies.status import LOCKED, STOPPED, Status, StatusFile
from cprl.studies.study import Block, Condition, Study
from cprl.system.output import quote_command
from cprl.system.shipped import cprl_command
from cprl.values import custom_targets, describe_changes, trust, trusted, without_defaults

DirectoryState = Literal[RunState, "refused"]
"""The state of a trial's directory; "refused" is a run of another trial, or of none that can be read."""
ATTEMPTS: Final = 5
"""Times that a trial is tried whose process dies."""


@dataclass(frozen=True, eq=False)
class Trial:
    """A run of a study: one block of replicas of one condition."""

    condition: Condition
    block: Block
    runs: Path = Path()
    """The directory that holds the directories of all trials."""

    @cached_property
    def experiment(self) -> Experiment:
        """Return the experiment of the run.

        A run numbers its replicas from 0. So `Frozen` agents, which name a stored replica for each replica of
        the study, get those of this block.
        """
        first = self.block.first
        last = self.block.first + self.block.replicas

        def in_block(stored: Frozen) -> Frozen:
            if isinstance(stored.replica, tuple):
                return replace(stored, replica=stored.replica[first:last])
            if stored.replica is None and first:
                return replace(stored, replica=tuple(range(first, last)))
            return stored

        experiment = self.condition.experiment
        agents = tuple(with_stored(spec, in_block) for spec in experiment.agents)
        return replace(
            experiment,
            seed=self.block.seed,
            replicas=self.block.replicas,
            agents=agents,
            governor=with_stored(experiment.governor, in_block),
            engine=self.condition.engine,
        )

    @cached_property
    def checksum(self) -> str:
        """Return the checksum of the condition for runs in this directory."""
        return self.condition.checksum_in(self.runs)

    @property
    def name(self) -> str:
        """Return the name of the trial's directory: checksum of the condition, seed, number of replicas."""
        return f"{self.checksum}-s{self.experiment.seed}-r{self.experiment.replicas}"

    @property
    def label(self) -> str:
        """Return a name for people, e.g. "gamma=0.9, replicas 0-7"."""
        first = self.block.first
        last = self.block.first + self.block.replicas - 1
        numbers = f"replica {first}" if first == last else f"replicas {first}-{last}"
        return f"{self.condition.name}, {numbers}"

    @property
    def directory(self) -> Path:
        return self.runs / self.name

    def state(self) -> DirectoryState:
        """Return the state of the trial's directory."""
        state = state_of(self.directory)
        try:
            if state != "missing":
                self.refuse_another()
        except ValueError:
            return "refused"
        return state

    def refuse_another(self) -> None:
        """Refuse a directory that holds another run, e.g. one that was renamed or restored from a backup.

        A run that is not finished may be shorter than the trial: it is a copy that will be continued.

        Raises:
            ValueError: for another run; the message says how it differs.
        """
        run = self.directory
        stored = recipe_config(read_recipe(run))
        expected = self.experiment.to_recipe(run)["experiment"]
        may_grow = Length.of(stored).is_shorter_than(self.experiment.length)
        may_grow = may_grow and state_of(run) != "finished"
        free = without_length(NEUTRAL_FIELDS) if may_grow else NEUTRAL_FIELDS
        if differ := describe_changes({**stored, **free}, {**expected, **free}, "experiment", Experiment):
            raise ValueError(
                f"{run} was started as another trial than its name says: {differ[0]}; give it back its name, "
                "or move it away"
            )


def trials_of(study: Study, runs: Path | str = ".") -> list[Trial]:
    """Return all trials of a study: the first block of every condition, then the second blocks, and so on.

    Args:
        runs: the directory of their runs. The names of trials with `Frozen` agents depend on it.
    """
    runs = Path(runs)
    return [Trial(condition, block, runs) for block in study.blocks for condition in study.all_conditions]


def is_of_other_code(run: Path) -> bool:
    """Return whether the user's own code has changed since the run was made."""
    try:
        return state_of(run) != "missing" and bool(changed_code(read_recipe(run)))
    except ValueError:  # its recipe cannot be read, which is a failure of the trial
        return False


def move_aside(runs: Sequence[Path]) -> list[Path]:
    """Move runs into a folder beside theirs, e.g. `runs-earlier`, and return their new directories.

    Raises:
        RunLockedError: if another process writes one of them. Then none is moved.
    """
    for run in runs:
        with RunLock(run):
            pass
    return list(map(_move_aside, runs))


def _move_aside(run: Path) -> Path:
    """Move one run as `move_aside` does, under a name that is free."""
    earlier = Path(os.path.abspath(run.parent))
    earlier = earlier.with_name(f"{earlier.name}-earlier")
    with RunLock(run):
        earlier.mkdir(exist_ok=True)
        taken = {path.name for path in earlier.iterdir()}
        aside = earlier / next(name for n in count(1) if (name := f"{run.name}-{n}") not in taken)
        shutil.move(run, aside)
    (aside / LOCK_FILE).unlink(missing_ok=True)
    return aside


class TrialOutcome(NamedTuple):
    """The outcome of a trial."""

    name: str
    state: Literal["finished", "failed", "elsewhere"]
    """"elsewhere" means that another process is running the trial."""
    reason: str = ""
    """The error of a failure, in a line."""
    worked: bool = False
    """True if the trial was run; False if it was finished already."""
    command: str = ""
    """The command line that repeats a failed trial by hand."""


class FinishedRuns:
    """An index of the finished runs in a directory, to find runs of an experiment that differ in length only.

    It reads the recipe of each run once, since a study may have thousands.
    """

    def __init__(self, runs: Path) -> None:
        self._runs = runs
        self._read: set[str] = set()
        self._by_content: dict[str, list[Path]] = {}

    def longest_shorter(self, config: Mapping[str, Any]) -> Path | None:
        """Return the longest run that is a shorter version of an experiment and can be extended."""
        for path in self._runs.glob("*"):
            if path.name not in self._read and state_of(path) == "finished":
                self._read.add(path.name)
                with suppress(ValueError, KeyError, TypeError):  # of a recipe that cannot be read
                    content = _content_of(recipe_config(read_recipe(path)))
                    self._by_content.setdefault(content, []).append(path)
        beginnings = []
        for run in self._by_content.get(_content_of(config), []):
            stored = read_recipe(run)
            length = Length.of(recipe_config(stored))
            is_kept = endings_of(run) and not changed_code(stored)
            if is_kept and length.is_shorter_than(Length.of(config)):
                beginnings.append((length.number, run))
        return max(beginnings)[1] if beginnings else None


def _content_of(config: Mapping[str, Any]) -> str:
    """Return a digest that is equal for experiments that differ in their length only."""
    table = without_defaults(without_length({**config, **NEUTRAL_FIELDS}), Experiment)
    return digest_of(json.dumps(table, sort_keys=True))


@dataclass(frozen=True, kw_only=True)
class Task:
    """The work on a trial: preparing its directory, running it, and finding out how it ended."""

    trial: Trial
    status: Status
    finished: FinishedRuns
    """The index of finished runs, shared by all tasks of a study."""
    keep_checkpoint: bool = False
    """True if the finished run keeps the state of its training, so that a longer trial can continue it."""
    take_over: bool = False
    """True if the lock of a process on another host, which gives no sign of life, is taken over."""

    @property
    def name(self) -> str:
        return self.trial.name

    @property
    def directory(self) -> Path:
        return self.trial.directory

    @property
    def recipe(self) -> dict[str, Any]:
        """Return the recipe that is stored in the trial's directory."""
        return self.trial.experiment.to_recipe(self.directory)

    @property
    def targets(self) -> tuple[str, ...]:
        """Return the user's own code that the trial may import: that of the experiment, and all that this
        process trusts."""
        return tuple(dict.fromkeys([*custom_targets(self.recipe["experiment"]), *trusted()]))

    @property
    def command_words(self) -> list[str]:
        """Return the words after `cprl` on the command line that runs the trial."""
        allow = [word for target in self.targets for word in ("--allow", target)]
        keep = "--keep-checkpoint" if self.keep_checkpoint else "--no-keep-checkpoint"
        experiment = self.trial.experiment
        directory = os.path.abspath(self.directory)
        length = experiment.length.flag, str(experiment.length.number)
        return ["run", directory, "--resume", *length, "--watch", "off", keep, *allow]

    @property
    def command(self) -> str:
        """Return the command line that runs the trial, quoted for a shell."""
        return quote_command([*cprl_command(), *self.command_words])

    @property
    def arguments(self) -> list[str]:
        """Return the arguments of Python in the trial's process."""
        return ["-m", "cprl", *self.command_words, "--trial", os.path.abspath(self.status.path)]

    @property
    def variables(self) -> dict[str, str]:
        """Return environment variables with which the process imports the same modules as this one."""
        return {"PYTHONPATH": os.pathsep.join(map(os.path.abspath, sys.path))}

    def run_of_another_engine(self) -> Path | None:
        """Return a shorter run that the trial could continue if it used the same engine; else None.

        With engine="auto" the engine depends on the length, so a longer trial may use another one.
        """
        if self.trial.condition.experiment.engine != "auto" or self.directory.exists():
            return None
        config = self.recipe["experiment"]
        if self.finished.longest_shorter(config):
            return None
        other = "compiled" if config["engine"] == "eager" else "eager"
        return self.finished.longest_shorter({**config, "engine": other})

    def settled(self) -> TrialOutcome | None:
        """Return the outcome of a trial that need not or cannot be run, and None for any other.

        Such a trial is finished or runs elsewhere, or its directory is damaged or holds another run.
        """
        return self._tried(self._check)

    def begin(self) -> TrialOutcome | None:
        """Prepare the directory for `cprl run`; return an outcome if there is nothing to run."""
        return self._tried(self._check) or self._tried(self._prepare)

    def _tried(self, step: Callable[[], TrialOutcome | None]) -> TrialOutcome | None:
        try:
            return step()
        except RunLockedError:
            return TrialOutcome(self.name, "elsewhere")
        except Exception as error:
            return self.failed(f"{type(error).__name__}: {error}", traceback.format_exc())

    def _check(self) -> TrialOutcome | None:
        """Return the outcome of a finished trial; refuse a directory that is in use or holds another run."""
        run = self.directory
        state = state_of(run)
        if state != "missing":
            self.trial.refuse_another()
        if state == "finished":
            refuse_missing(run)
            self.status.tidy_up()
            return TrialOutcome(self.name, "finished")
        if run.exists():
            with RunLock(run, take_over=self.take_over):
                pass
        return None

    def _prepare(self) -> TrialOutcome | None:
        """Write the recipe, or copy a shorter run; return an outcome if another process was faster."""
        run = self.directory
        experiment = self.trial.experiment
        self.status.folder.mkdir(parents=True, exist_ok=True)
        self.status.tidy_up()
        break_hard_links(self.status.log)
        with open(self.status.log, "a", encoding="utf-8") as log:
            log.write(f"$ {self.command}\n")
        if not run.exists():
            begin_from_shorter(run, experiment, self.recipe, self.finished)
        if run.exists():
            with RunLock(run, take_over=self.take_over):
                if state_of(run) == "missing":
                    remove_partial(run)  # of a process that was killed before it had written a recipe
                else:
                    write_on_nan(run, experiment.on_nan)
        if state_of(run) != "missing":
            return None
        try:
            start(run, experiment, partners_in(experiment.specs))
        except FileExistsError:
            if state_of(run) == "missing" and not (run / LOCK_FILE).exists():
                raise
            return TrialOutcome(self.name, "elsewhere")  # somebody else has begun it
        return None

    def ended(self, code: int) -> TrialOutcome | None:
        """Return the outcome after the process ended; None if it died or was stopped and may be resumed.

        Args:
            code: the exit code; negative for a signal.
        """
        if state_of(self.directory) == "finished":
            self.status.tidy_up()
            return TrialOutcome(self.name, "finished", worked=True)
        if code == LOCKED:
            return TrialOutcome(self.name, "elsewhere")
        if code < 0 or code in STOPPED:
            return None
        reason = self.status.failure()
        if reason is not None:
            return self.failed(reason)
        lines = self.status.log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return self.failed(f"{lines[-1].strip()} (exit code {code})", "\n".join(lines[-100:]))

    def given_up(self) -> TrialOutcome:
        """Return the outcome of a trial whose process died in every attempt."""
        reason = (
            f"its process died, {ATTEMPTS} times; one that is killed is often one for which memory was short"
        )
        return self.failed(reason, f"What it printed is in {self.status.log}.")

    def failed(self, reason: str, trace: str = "") -> TrialOutcome:
        """Return the outcome of a failed trial, and write the trace to its status files."""
        if trace:
            self.status.fail(reason, trace)
        return TrialOutcome(self.name, "failed", reason, worked=True, command=self.command)

    def run_here(self) -> TrialOutcome:
        """Run the trial in this process."""
        return self.begin() or self._tried(self._run) or TrialOutcome(self.name, "finished", worked=True)

    def _run(self) -> None:
        """Run the experiment in the trial's directory, with its output in the trial's log."""
        from cprl.training.running import run

        name = str(read_recipe(self.directory)["experiment"]["name"])  # perhaps that of another study
        experiment = replace(self.trial.experiment, name=name)
        trust(*self.targets)
        with (
            open(self.status.log, "a", encoding="utf-8", errors="replace") as log,
            redirect_stdout(log),
            redirect_stderr(log),
            StatusFile(self.status, experiment) as status,
        ):
            run(
                experiment,
                self.directory,
                resume=True,
                keep_checkpoint=self.keep_checkpoint,
                watch="off",
                figures=False,
                callbacks=(status,),
            )


def begin_from_shorter(
    run: Path, experiment: Experiment, recipe: Mapping[str, Any], finished: FinishedRuns
) -> None:
    """Begin a run as a copy of the longest shorter run of the same experiment, which resuming then extends.

    The shorter run must have kept the state of its training. It stays as it is. A copy that was interrupted
    is made anew. Nothing is copied if a callback may depend on the number of episodes.
    """
    callbacks = [callback.resolve() for callback in experiment.callbacks]
    if any(not isinstance(callback, type) or depends_on_episodes(callback) for callback in callbacks):
        return
    shorter = finished.longest_shorter(recipe["experiment"])
    if shorter is None:
        return
    copying = run.with_name(f".{run.name}.copying-{os.getpid()}")
    shutil.rmtree(copying, ignore_errors=True)
    try:
        shutil.copytree(shorter, copying, ignore=shutil.ignore_patterns(REPORT, LOCK_FILE))
        copying.rename(run)
    except OSError:
        if not run.exists():  # else somebody else has begun it meanwhile
            raise
    finally:
        shutil.rmtree(copying, ignore_errors=True)
