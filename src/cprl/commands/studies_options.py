"""How a study is run, as options of a command line: `cprl sweep` and recipes of studies share them."""

import os
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import tyro

from cprl.arguments import LAST, integer
from cprl.commands.recipe import ended_by_sigterm
from cprl.runs.directory import without_directories, without_options
from cprl.system.output import RESUMES, console, printed, say
from cprl.system.shipped import command_of, named_command

if TYPE_CHECKING:
    from cprl.studies import Search, SearchResult, Study, StudyResult
    from cprl.studies.executors import Executor
    from cprl.studies.trials import Outcome, Trial

_BEST: Final = 10
"""Points of a search that are printed."""


@dataclass(frozen=True, kw_only=True)
class StudyOptions:
    """How a study is run and compared; nothing of it changes a run."""

    out: Path | None = None
    """The study's directory; by default studies/NAME. The same line continues a study that was stopped, and
    runs what is new in one that was changed."""
    runs: Path | None = None
    """The directory of the runs, which several studies may share; by default runs/ in the study's."""
    jobs: int | None = None
    """Trials that run at the same time."""
    only: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Run a condition alone, or those with some levels: "gamma=0.9", "gamma=0.9, freeze_steps=5"; may be
    repeated. The others stay as they are, so that several machines can share a study."""
    keep_checkpoints: bool = False
    """Keep the state of each training, buffers included (an agent's takes as much as its buffer), so that the
    same study with more --episodes goes on from there."""
    on: Literal["here", "processes", "ray"] | None = None
    """Where trials are run: one after the other in this process, in processes on this machine, or by Ray
    (extra "ray"); by default here, and in processes with more than one of --jobs."""
    address: str | None = None
    """Of a Ray cluster: "auto", or HOST:PORT; with --on ray."""
    figures: bool = True
    """Write the table, summary and figures at the end."""
    last: int = LAST
    """Episodes at the end of the training that these compare; of long trainings rather 500."""
    dry_run: bool = False
    """List all conditions, trials and their states; run and write nothing."""
    allow: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """A class of somebody's own that stored runs may import, "module:Class"; may be repeated."""


def executor_of(options: StudyOptions) -> "Executor":
    """Where trials are run.

    Raises:
        ValueError: for options that contradict each other.
    """
    from cprl.studies.executors import InProcess, Processes, Ray

    jobs, on = options.jobs, options.on
    if jobs is not None:
        integer("--jobs", jobs, 1, 4096)
    on = on or ("processes" if (jobs or 1) > 1 else "here")
    if options.address is not None and on != "ray":
        raise ValueError(f"--address is for --on ray, and this is --on {on}; allowed: one with the other")
    if on == "here":
        if (jobs or 1) > 1:
            raise ValueError(f"--jobs is {jobs} with --on here; allowed: 1, or --on processes")
        return InProcess()
    if on == "ray":
        return Ray(options.address, jobs=jobs)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return Processes(jobs or cores)


def carry_out(what: "Study | Search", options: StudyOptions, command: Sequence[str]) -> Path:
    """Runs a study or a search as the command line asks for it, and says what came of it.

    Args:
        what: the study or search.
        options: how it is run.
        command: the command line, script first, which is said where it can be used again.

    Returns:
        The study's directory.

    Raises:
        ValueError: for whatever does not fit, before anything is written.
        SystemExit: with code 1 where trials have failed, and 130 or 143 where it was interrupted.
    """
    from cprl.studies import Search, run_search, run_study

    executor, again = executor_of(options), printed(command_of(command))
    if isinstance(what, Search):
        for flag, value in {"--only": options.only, "--keep-checkpoints": options.keep_checkpoints}.items():
            if value:
                raise ValueError(
                    f"{flag} is for studies, and this is a search; allowed: one without the other"
                )
    if options.dry_run:
        return _list(what, options)
    names = ("runs", "allow", "last")
    how: dict[str, Any] = {"on": executor, **{own: getattr(options, own) for own in names}}
    program, *words = named_command(command)
    whole = without_options(words, ["--only"])  # what a part of a study lacks, it lacks
    how |= {"results": options.figures, "again": printed([without_directories(program), *whole])}
    with _interruptible(again):
        result: StudyResult | SearchResult
        if isinstance(what, Search):
            result = run_search(what, options.out, **how)
            _say_best(result)
        else:
            how |= {"only": options.only, "keep_checkpoints": options.keep_checkpoints}
            result = run_study(what, options.out, **how)
    say(result.out)
    if result.failed:
        _say_failed(result, again)
        sys.exit(1)
    return result.out


def _list(what: "Study | Search", options: StudyOptions) -> Path:
    """Prints all trials and their states."""
    from cprl.studies import Search, Study
    from cprl.studies.directory import RUNS, STATUS, directory_of
    from cprl.studies.execution import trials_with
    from cprl.studies.overview import Overview
    from cprl.studies.progress import table_of
    from cprl.studies.status import BEAT_S
    from cprl.studies.trials import trials_of

    study = Study(what.experiment, name=what.name) if isinstance(what, Search) else what
    out = directory_of(study, options.out)
    if isinstance(what, Search):
        factors = ", ".join(f"{name}: {own}" for name, own in what.factors.items())
        say(f"{what.points} points of {factors}, found one after the other, in {out}; nothing was written")
        return out
    trials = trials_with(trials_of(study), options.only)
    runs = out / RUNS if options.runs is None else options.runs
    overview = Overview(trials, runs=runs, status=out / STATUS)
    now = overview.look()
    if now.counts["unfinished"]:  # those that run say something new within a second
        time.sleep(1.5 * BEAT_S)
        now = overview.look()
    console(width=None if sys.stdout.isatty() else 160).print(table_of(now, title=study.name))
    names = ", ".join(study.columns)
    say(
        f"{len(study.all_conditions)} conditions ({names}), {study.replicas} replicas each, in {runs}; "
        "nothing was written"
    )
    return out


def _say_best(result: "SearchResult") -> None:
    search = result.search
    words = {"maximise": "highest", "minimise": "lowest"}[search.direction]
    say(f"{search.name}: {len(result.points)} points; the {words} {search.metric}, means over replicas:")
    for point in result.ranked[:_BEST]:
        say(f"  {point.value:10.6g}  {point.name}")
    refused = [own for own in result.points if own.reason]
    if refused:
        say(f"  {len(refused)} points were refused, e.g. {refused[0].name}: {refused[0].reason}")


def _say_failed(result: "StudyResult | SearchResult", again: str) -> None:
    """Lists the trials that failed, where to look, and what to do."""
    from cprl.studies.directory import STATUS
    from cprl.studies.overview import label_of
    from cprl.studies.status import Status

    trials: dict[str, Trial] = {trial.name: trial for trial in result.trials}
    outcomes: dict[str, Outcome] = {own.name: own for own in result.failed}
    lines = [f"{len(outcomes)} of {len(trials)} trials failed; the others are kept:"]
    for name, outcome in outcomes.items():
        status = Status(result.out / STATUS, name)
        where = status.failed if status.failed.exists() else status.log
        lines += [f"  {label_of(trials[name])}: {outcome.reason}", f"    {where}"]
    say("\n".join([*lines, f"To try them again: {again}"]))


@contextmanager
def _interruptible(again: str) -> Iterator[None]:
    """Says what is kept, and what continues, where the block is ended by Ctrl-C (SIGINT) or SIGTERM."""
    try:
        with ended_by_sigterm():
            yield
    except (KeyboardInterrupt, SystemExit) as error:
        kept = [note for note in getattr(error, "__notes__", []) if not note.startswith(RESUMES)]
        say("\n".join(["Interrupted.", *kept, f"To continue: {again}"]))
        sys.exit(130 if isinstance(error, KeyboardInterrupt) else error.code)
