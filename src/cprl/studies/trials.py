"""Trials: runs of a study, one for each condition and block of replicas, each in a directory of its own.

The truth of a study lies in these directories. A trial is begun when its recipe is written there; from then
on `cprl run DIRECTORY --resume` makes a finished run of it, in a process of its own, whatever was there:
nothing but the recipe, or a run that was killed at any moment. `Task` is that process, from its command line
to what came of it.
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
from cprl.experiment.engine import engine_of
from cprl.population import Frozen, partners_in, with_stored
from cprl.runs.checkpoints import endings_of
from cprl.runs.files import (
    FREE,
    LOCK_FILE,
    REPORT,
    RunLock,
    RunLockedError,
    digest_of,
    refuse_missing,
    remove_partial,
    take_apart,
)
from cprl.runs.length import Length, without_length
from cprl.runs.recipe import (
    changed_code,
    read_recipe,
    recipe_config,
    write_on_nan,
)
from cprl.runs.states import State, depends_on_episodes, start, state_of
from cprl.studies.status import LOCKED, STOPPED, Status, StatusFile
from cprl.studies.study import Block, Condition, Study
from cprl.system.output import printed
from cprl.system.shipped import cprl_here
from cprl.values import custom_targets, differences, trust, trusted, without_defaults

DirectoryState = Literal[State, "refused"]
"""Of its directory; "refused" is a run of another trial, or of none that can be read."""
ATTEMPTS: Final = 5
"""How often a trial is tried whose process dies."""


@dataclass(frozen=True, eq=False)
class Trial:
    """One run of a study: a block of replicas of a condition."""

    condition: Condition
    block: Block
    runs: Path = Path()
    """The directory in which the trial's is."""

    @cached_property
    def experiment(self) -> Experiment:
        """Return what is run; stored agents play in its replicas, which a run numbers from 0 again."""
        first = self.block.first
        last = self.block.first + self.block.replicas

        def in_block(stored: Frozen) -> Frozen:
            if isinstance(stored.replica, tuple):
                return replace(stored, replica=stored.replica[first:last])
            if stored.replica is None and first:
                return replace(stored, replica=tuple(range(first, last)))
            return stored

        of_condition = self.condition.experiment
        agents = tuple(with_stored(spec, in_block) for spec in of_condition.agents)
        return replace(
            of_condition,
            seed=self.block.seed,
            replicas=self.block.replicas,
            agents=agents,
            engine=engine_of(of_condition),
        )

    @cached_property
    def checksum(self) -> str:
        return self.condition.checksum_in(self.runs)

    @property
    def name(self) -> str:
        """Return the name of its directory: the condition's checksum, the seed and the number of replicas."""
        return f"{self.checksum}-s{self.experiment.seed}-r{self.experiment.replicas}"

    @property
    def label(self) -> str:
        """Its condition, and which replicas of it, for people."""
        first = self.block.first
        last = self.block.first + self.block.replicas - 1
        numbers = f"replica {first}" if first == last else f"replicas {first}-{last}"
        return f"{self.condition.name}, {numbers}"

    def state(self, runs: Path) -> DirectoryState:
        """Return what its directory holds."""
        run = runs / self.name
        state = state_of(run)
        try:
            if state != "missing":
                self.refuse_another(run)
        except ValueError:
            return "refused"
        return state

    def refuse_another(self, run: Path) -> None:
        """Refuse a run that is not this trial, e.g. one that was renamed or restored from a backup.

        One that has not finished may have fewer episodes, or steps: a shorter run, copied to be continued.
        """
        stored = recipe_config(read_recipe(run))
        wanted = self.experiment.to_recipe(run)["experiment"]
        may_grow = Length.of(stored).is_shorter_than(self.experiment.length)
        may_grow = may_grow and state_of(run) != "finished"
        free = without_length(FREE) if may_grow else FREE
        if differ := differences({**stored, **free}, {**wanted, **free}, "experiment", Experiment):
            raise ValueError(
                f"{run} was started as another trial than its name says: {differ[0]}; give it back its name, "
                "or move it away"
            )


def trials_of(study: Study, runs: Path | str = ".") -> list[Trial]:
    """Return every trial of a study: the first blocks of all conditions, then their second ones, and so on.

    Args:
        runs: the directory in which theirs are, on which their names depend where stored agents play.
    """
    runs = Path(runs)
    return [Trial(condition, block, runs) for block in study.blocks for condition in study.all_conditions]


def is_of_other_code(run: Path) -> bool:
    """Return whether a run was made with other code of the user's own than is there now."""
    try:
        return state_of(run) != "missing" and bool(changed_code(read_recipe(run)))
    except ValueError:  # its recipe cannot be read, which is a failure of the trial
        return False


def move_aside(runs: Sequence[Path]) -> list[Path]:
    """Move runs out of the way, into a folder beside theirs, `runs-earlier`, and return where they are now.

    Raises:
        RunLockedError: where another process writes one of them; then none is moved.
    """
    for run in runs:
        with RunLock(run):
            pass
    return list(map(_move_aside, runs))


def _move_aside(run: Path) -> Path:
    earlier = Path(os.path.abspath(run.parent))
    earlier = earlier.with_name(f"{earlier.name}-earlier")
    with RunLock(run):
        earlier.mkdir(exist_ok=True)
        taken = {path.name for path in earlier.iterdir()}
        aside = earlier / next(name for n in count(1) if (name := f"{run.name}-{n}") not in taken)
        shutil.move(run, aside)
    (aside / LOCK_FILE).unlink(missing_ok=True)
    return aside


class Outcome(NamedTuple):
    name: str
    state: Literal["finished", "failed", "elsewhere"]
    """"elsewhere" while another process runs it."""
    reason: str = ""
    """Of a failure: the error in a line."""
    worked: bool = False
    """Whether anything had to be done."""
    command: str = ""
    """Of a failure: the command line that repeats the trial by hand."""


class FinishedRuns:
    """Finds the finished runs of a directory that are the same experiment but for its length; reads the
    recipe of each run once."""

    def __init__(self, runs: Path) -> None:
        self._runs = runs
        self._read: set[str] = set()
        self._by_content: dict[str, list[Path]] = {}

    def like(self, config: Mapping[str, Any]) -> list[Path]:
        """Return those of an experiment, in the order of their names."""
        for path in self._runs.glob("*"):
            if path.name not in self._read and state_of(path) == "finished":
                self._read.add(path.name)
                with suppress(ValueError, KeyError, TypeError):  # of a recipe that cannot be read
                    content = _content_of(recipe_config(read_recipe(path)))
                    self._by_content.setdefault(content, []).append(path)
        return sorted(self._by_content.get(_content_of(config), []))


def _content_of(config: Mapping[str, Any]) -> str:
    """Return what tells experiments from others that differ in more than their length."""
    table = without_defaults(without_length({**config, **FREE}), Experiment)
    return digest_of(json.dumps(table, sort_keys=True))


@dataclass(frozen=True, kw_only=True)
class Task:
    """A trial in its directory, and the process that makes a finished run of it."""

    trial: Trial
    runs: Path
    """The directory in which the trial's is."""
    status: Status
    keep_checkpoint: bool = False
    """Whether the finished run keeps the state of its training, so that a longer trial can go on from it."""
    take_over: bool = False
    """Whether the lock is taken that a process on another host left behind."""
    finished: FinishedRuns | None = None
    """The finished runs of the directory, which the tasks of a study share."""

    @property
    def name(self) -> str:
        return self.trial.name

    @property
    def directory(self) -> Path:
        return self.runs / self.name

    @property
    def recipe(self) -> dict[str, Any]:
        """Return what the trial's directory says that it is."""
        return self.trial.experiment.to_recipe(self.directory)

    @property
    def targets(self) -> tuple[str, ...]:
        """Return the user's own code that it may import: of this experiment, and what this process trusts."""
        return tuple(dict.fromkeys([*custom_targets(self.recipe["experiment"]), *trusted()]))

    @property
    def words(self) -> list[str]:
        """Return what stands after `cprl` on the command line that runs it."""
        allow = [word for target in self.targets for word in ("--allow", target)]
        keep = "--keep-checkpoint" if self.keep_checkpoint else "--no-keep-checkpoint"
        experiment = self.trial.experiment
        directory = os.path.abspath(self.directory)
        length = experiment.length.flag, str(experiment.length.number)
        return ["run", directory, "--resume", *length, "--watch", "off", keep, *allow]

    @property
    def command(self) -> str:
        return printed([*cprl_here(), *self.words])

    @property
    def arguments(self) -> list[str]:
        """Return what stands after Python on the command line of its process."""
        return ["-m", "cprl", *self.words, "--trial", os.path.abspath(self.status.path)]

    @property
    def variables(self) -> dict[str, str]:
        """Variables of its process, which imports what this one does from where this one does."""
        return {"PYTHONPATH": os.pathsep.join(map(os.path.abspath, sys.path))}

    def of_another_engine(self) -> Path | None:
        """Return the shorter run from which the trial would begin if engine="auto" stood for the engine that
        trained it; None where there is none such, and where the trial has begun."""
        if self.trial.condition.experiment.engine != "auto" or self.directory.exists():
            return None
        finished = self.finished or FinishedRuns(self.runs)
        config = self.recipe["experiment"]
        engines = sorted({"eager", "compiled"} - {config["engine"]})
        shorter = [_longest_shorter({**config, "engine": engine}, finished) for engine in engines]
        return None if _longest_shorter(config, finished) else shorter[0]

    def settled(self) -> Outcome | None:
        """Return what there is to say of a trial that cannot be run now: a finished one, one in whose
        directory another trial's run is, or a finished one that lost a file; None of one that can."""
        return self._tried(self._check)

    def begin(self) -> Outcome | None:
        """Make the directory ready for `cprl run`; an outcome where there is nothing to be run."""
        return self._tried(self._check) or self._tried(self._prepare)

    def _tried(self, step: Callable[[], Outcome | None]) -> Outcome | None:
        try:
            return step()
        except RunLockedError:
            return Outcome(self.name, "elsewhere")
        except Exception as error:
            return self.failed(f"{type(error).__name__}: {error}", traceback.format_exc())

    def _check(self) -> Outcome | None:
        run = self.directory
        state = state_of(self.directory)
        if state != "missing":
            self.trial.refuse_another(run)
        if state == "finished":
            refuse_missing(run)
            self.status.tidy_up()
            return Outcome(self.name, "finished")
        if run.exists():
            with RunLock(run, take_over=self.take_over):
                pass
        return None

    def _prepare(self) -> Outcome | None:
        run = self.directory
        experiment = self.trial.experiment
        self.status.folder.mkdir(parents=True, exist_ok=True)
        self.status.tidy_up()
        take_apart(self.status.log)
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
            start(run, experiment, partners_in(experiment.agents))
        except FileExistsError:
            if state_of(run) == "missing" and not (run / LOCK_FILE).exists():
                raise
            return Outcome(self.name, "elsewhere")  # somebody else has begun it
        return None

    def ended(self, code: int) -> Outcome | None:
        """Return the outcome where its process ended with an exit code; None where it died or was stopped."""
        if state_of(self.directory) == "finished":
            self.status.tidy_up()
            return Outcome(self.name, "finished", worked=True)
        if code == LOCKED:
            return Outcome(self.name, "elsewhere")
        if code < 0 or code in STOPPED:
            return None
        reason = self.status.failure()
        if reason is not None:
            return self.failed(reason)
        lines = self.status.log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return self.failed(f"{lines[-1].strip()} (exit code {code})", "\n".join(lines[-100:]))

    def given_up(self) -> Outcome:
        reason = (
            f"its process died, {ATTEMPTS} times; one that is killed is often one for which memory was short"
        )
        return self.failed(reason, f"What it printed is in {self.status.log}.")

    def failed(self, reason: str, trace: str = "") -> Outcome:
        if trace:
            self.status.fail(reason, trace)
        return Outcome(self.name, "failed", reason, worked=True, command=self.command)

    def run_here(self) -> Outcome:
        """Run the trial in this process, as `cprl run` does in one of its own."""
        return self.begin() or self._tried(self._run) or Outcome(self.name, "finished", worked=True)

    def _run(self) -> None:
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


def _longest_shorter(config: Mapping[str, Any], finished: FinishedRuns) -> Path | None:
    """Return the longest run that is the same experiment but shorter, and can be extended."""
    beginnings = []
    for other in finished.like(config):
        stored = read_recipe(other)
        length = Length.of(recipe_config(stored))
        is_kept = endings_of(other) and not changed_code(stored)
        if is_kept and length.is_shorter_than(Length.of(config)):
            beginnings.append((length.number, other))
    return max(beginnings)[1] if beginnings else None


def begin_from_shorter(
    run: Path, experiment: Experiment, recipe: Mapping[str, Any], finished: FinishedRuns | None = None
) -> Path | None:
    """Make a run that is not there of the longest finished one beside it that has fewer episodes, keeps the
    state of its training and is the same otherwise; it is then to be resumed with its own episodes.

    Returns the run that was copied, which stays as it is; None if there is none such, and where callbacks may
    depend on the number of episodes. A copy that was interrupted is made anew."""
    callbacks = [callback.resolve() for callback in experiment.callbacks]
    if any(not isinstance(callback, type) or depends_on_episodes(callback) for callback in callbacks):
        return None
    shorter = _longest_shorter(recipe["experiment"], finished or FinishedRuns(run.parent))
    if shorter is None:
        return None
    copying = run.with_name(f".{run.name}.copying-{os.getpid()}")
    shutil.rmtree(copying, ignore_errors=True)
    try:
        shutil.copytree(shorter, copying, ignore=shutil.ignore_patterns(REPORT, LOCK_FILE))
        copying.rename(run)
    except OSError:
        if not run.exists():  # else somebody else has begun it meanwhile
            raise
        return None
    finally:
        shutil.rmtree(copying, ignore_errors=True)
    return shorter
