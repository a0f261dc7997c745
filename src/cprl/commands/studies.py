"""The command lines of studies: `cprl sweep`, and `study_main` for recipes that describe a study."""

import importlib.util
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, TypeVar

import tyro

from cprl.commands.flags import with_help
from cprl.commands.recipe_command import (
    ALLOW,
    Words,
    ended_by_sigterm,
    exit_with_message,
    parse_with,
    trust_allowed,
    wrap_paragraphs,
)
from cprl.runs.length import UNITS, without_length
from cprl.runs.recipe import read_recipe, without_directories, without_options
from cprl.system.defaults import LAST_EPISODES
from cprl.system.output import console, quote_command, say
from cprl.system.shipped import command_line, is_shipped, program_name, recipe_named, typed_command_line
from cprl.system.waiting_room import experimental
from cprl.values import checked

if TYPE_CHECKING:
    from cprl.experiment import Experiment
    from cprl.studies import Study, StudyResult
    from cprl.studies.executors import Executor

_RECIPE: Final = (
    "A Python file with a function `experiment`, the name of a recipe (cprl recipe lists them), a "
    "recipe.json, or the directory of a run."
)
_MODULE: Final = "cprl_swept_recipe"
_NOTE: Final = (
    "With --vary PATH=VALUES any value below is varied: "
    'commas stand between values, "x" or spaces between the numbers of one value (hidden-cells=32x32,64x64). '
    "agents.*.PATH means every agent that learns, agents.0.PATH one. Values may also be True, False, None, "
    "names, and boards by their names. In a search and with --draws a range may stand in their place: "
    "uniform(LOW,HIGH), loguniform(LOW,HIGH) or integers(LOW,HIGH). Every other flag below is the same in "
    "all conditions; --replicas is the number in each condition."
)
_ABOUT: Final = "Run a recipe under several conditions."


@dataclass(frozen=True, kw_only=True)
class TrialOptions:
    """Options of how trials are run and compared. None of them changes a run."""

    out: Path | None = None
    """The study's directory; by default studies/NAME. The same line continues a study that was stopped, and
    runs what is new in one that was changed."""
    runs: Path | None = None
    """The directory of the runs, which several studies may share; by default runs/ in the study's."""
    jobs: int | None = None
    """Trials that run at the same time."""
    on: Literal["here", "processes", "ray"] | None = None
    """The place where trials are run: one after the other in this process, in processes on this machine, or
    by Ray (extra "ray"); by default here, and in processes with more than one of --jobs."""
    address: str | None = None
    """The address of a Ray cluster: "auto", or HOST:PORT; with --on ray."""
    figures: bool = True
    """Write the table, summary and figures at the end."""
    last: int = LAST_EPISODES
    """The number of episodes at the end of the training that results compare; 500 suits long trainings."""
    dry_run: bool = False
    """List all conditions, trials and their states; run and write nothing."""
    block: int | None = None
    """Replicas that one run trains side by side, by default 8; with fewer, more processes share the work."""


@dataclass(frozen=True, kw_only=True)
class VariedOptions(TrialOptions):
    """Options that say what is varied, and how trials are run."""

    vary: Words = ()
    """PATH=VALUE,VALUE,... e.g. game.rules.freeze-steps=5,25,100, or PATH=loguniform(LOW,HIGH); may be
    repeated. A sweep runs every combination of values, a search the points that it chooses."""


@dataclass(frozen=True, kw_only=True)
class StudyOptions(TrialOptions):
    """Options of how a study is run."""

    only: Words = ()
    """Run a condition alone, or those with some levels: "gamma=0.9", "gamma=0.9, freeze_steps=5"; may be
    repeated. The others stay as they are, so that several machines can share a study."""
    keep_checkpoints: bool = False
    """Keep the state of each training, buffers included (an agent's takes as much as its buffer), so that the
    same study with more --episodes goes on from there."""


@dataclass(frozen=True, kw_only=True)
class MainOptions(StudyOptions):
    """Options of a recipe that describes a study."""

    episodes: int | None = None
    """Episodes of each condition; by default as many as the study says."""
    steps: int | None = None
    """Steps of each condition of a study that counts steps; by default as many as the study says."""
    replicas: int | None = None
    """Replicas of each condition; by default as many as the study says."""


@dataclass(frozen=True, kw_only=True)
class SweepOptions(StudyOptions, VariedOptions):
    """Options of `cprl sweep`: what is varied, and how it is run."""

    draws: int | None = None
    """The number of random combinations that are run instead of all combinations."""
    design: Literal["random", "latin_hypercube", "sobol"] = "random"
    """The way to draw combinations, with --draws: independently, or evenly over all ranges."""
    reference: str | None = None
    """The name of the condition that others are compared with, e.g. "freeze_steps=25"."""


ResultT = TypeVar("ResultT")


VariedOptionsT = TypeVar("VariedOptionsT", bound=VariedOptions)


def study_main(study: "Study", argv: Sequence[str] | None = None) -> Path:
    """Run a study with the options of a command line. A recipe that describes a study ends with this call.

    Args:
        study: the study to run.
        argv: the command line, beginning with the script; by default that of this process.

    Returns:
        The study's directory.

    Raises:
        SystemExit: if the command line is refused, with the reason; with code 1 if trials failed, and with
            130 or 143 if SIGINT (Ctrl-C) or SIGTERM interrupted the study.
    """
    command = list(sys.argv if argv is None else argv)
    script = program_name(command[0])
    with exit_with_message(script):
        words = trust_allowed(command[1:])
        options = tyro.cli(MainOptions, args=words, prog=script, description=_about(study), config=_CONFIG)
        changes = study_fields(options)
        length = {unit: changes.pop(unit) for unit in UNITS if unit in changes}
        if length:
            changes["experiment"] = replace(study.experiment, **without_length({}) | length)
        study = replace(study, **changes)
        for unit, number in length.items():
            for condition in study.all_conditions:
                stated = getattr(condition.experiment, unit)
                if stated != number:
                    raise ValueError(
                        f"--{unit} is {number}, and the study's condition {condition.name} says {stated}; "
                        f"allowed: --{unit} where no condition says how many"
                    )
        return carry_out(study, options, command)


def study_fields(options: TrialOptions) -> dict[str, Any]:
    """Return the options that are fields of a `Study` or a search, without those that are not given.

    These are the fields that the class of the options defines itself; inherited ones say how trials are run.
    """
    names = {"block", *type(options).__annotations__}
    return {name: value for name, value in vars(options).items() if name in names and value is not None}


def sweep(words: Sequence[str], /) -> None:
    """Run a recipe under several conditions: cprl sweep RECIPE --vary ...

    Args:
        words: the words after `cprl sweep`. The first is a Python file with a function `experiment`, the name
            of a recipe that comes with cprl, a recipe.json, or the directory of a run. Options follow.
    """
    experiment, options = read_recipe_and_options(words, SweepOptions(), "cprl sweep", about=_ABOUT)

    from cprl.studies import Study
    from cprl.studies.factors import factors_of

    study = Study(experiment, factors_of(experiment, options.vary), **study_fields(options))
    carry_out(study, options, ["cprl", "sweep", *words])


def read_recipe_and_options(
    words: Sequence[str], options: VariedOptionsT, program: str, *, about: str
) -> "tuple[Experiment, VariedOptionsT]":
    """Parse a recipe and the options after it; print the help if it is asked for.

    Args:
        words: the words after the command.
        options: the default options.
        program: the command, e.g. "cprl sweep".
        about: the first sentence of the help.
    """
    words = trust_allowed(words)
    if not words or words[0] in ("-h", "--help"):
        _print_help(options, program, about)
    if words[0].startswith("-"):
        raise ValueError(
            f"the first word after {program} is {words[0]}; allowed: a recipe, e.g. {program} "
            "recipes/commons.py --vary game.rules.freeze-steps=5,25,100"
        )
    source = recipe_named(words[0]).path if is_shipped(words[0]) else Path(words[0])
    sys.path[:0] = [str(source.resolve().parent)] if source.suffix == ".py" and source.is_file() else []
    note = f"{about} {_NOTE}"
    experiment, options = parse_with(
        recipe_of(source), words[1:], options, program=f"{program} {words[0]}", note=note
    )
    if not options.vary:
        raise ValueError("nothing is varied; allowed: --vary PATH=VALUE,VALUE..., at least once")
    return experiment, options


def _print_help(options: VariedOptions, program: str, about: str) -> None:
    """Print the help of a command that varies a recipe, and end the process."""
    kind: Any = type(options)

    def read(
        recipe: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(help=_RECIPE)],
        options: Annotated[kind, tyro.conf.arg(name="")] = options,
    ) -> None:
        """Never called: tyro reads the flags from its annotations."""

    listed = f"The flags of a recipe are listed by {program} RECIPE --help."
    text = "\n\n".join([about, _NOTE, listed, ALLOW])
    tyro.cli(
        with_help(read),
        args=["--help"],
        prog=program,
        description=wrap_paragraphs(text),
        config=(*_CONFIG, tyro.conf.DisallowNone),
    )


def recipe_of(source: Path) -> "Callable[..., Experiment]":
    """Return the function that makes the experiment of a recipe.

    Args:
        source: a Python file with a function `experiment`, which is imported; a recipe.json; or the directory
            of a run.

    Raises:
        ValueError: for anything else.
    """
    if source.suffix != ".py" or source.is_dir():
        directory = source if source.is_dir() else source.parent
        content = read_recipe(source)

        from cprl.experiment import Experiment

        stored = Experiment.from_recipe(content, directory=directory)

        def experiment() -> Experiment:
            return stored

        experiment.__doc__ = f"The experiment of {source}."
        return experiment
    spec = importlib.util.spec_from_file_location(_MODULE, source)
    if not source.is_file() or spec is None or spec.loader is None:
        raise ValueError(f"the recipe is {source}; allowed: a Python file, a recipe.json, a run's directory")
    module = importlib.util.module_from_spec(spec)
    sys.modules[_MODULE] = module  # tyro reads its types
    spec.loader.exec_module(module)
    make_experiment: Callable[..., Experiment] | None = getattr(module, "experiment", None)
    if not callable(make_experiment):
        if hasattr(module, "STUDY"):
            line = quote_command(["python", str(source)])
            raise ValueError(f"{source} describes a study, which is run by itself: {line}")
        raise ValueError(f"{source} has no function `experiment`; allowed: one that gives an Experiment")
    return make_experiment


def _about(study: "Study") -> str:
    """Return the text about a study in its `--help`."""
    from cprl.studies.tables.tidy_table import abbreviated

    conditions = study.all_conditions
    names = abbreviated([condition.name for condition in conditions], _LISTED)
    parts = [
        study.question,
        f"Expected: {study.expectation}" if study.expectation else "",
        f"{len(conditions)} conditions: {names}; {study.replicas} replicas of each.",
        ALLOW,
    ]
    return "\n\n".join(filter(None, parts))


_LISTED: Final = 20
"""The largest number of conditions that the `--help` of a study names."""
_CONFIG: Final = (tyro.conf.HelptextFromCommentsOff,)


def executor_of(options: TrialOptions) -> "Executor":
    """Return the executor for the options --on, --jobs and --address.

    Raises:
        ValueError: for options that do not go together.
    """
    from cprl.studies.executors import InProcess, Jobs, Processes

    jobs = 1 if options.jobs is None else checked("--jobs", options.jobs, Jobs)
    on = options.on or ("processes" if jobs > 1 else "here")
    if options.address is not None and on != "ray":
        raise ValueError(f"--address is for --on ray, and this is --on {on}; allowed: one with the other")
    if on == "here" and jobs > 1:
        raise ValueError(f"--jobs is {jobs} with --on here; allowed: 1, or --on processes")
    if on == "ray":
        ray: Executor = experimental("ray_executor.Ray")(options.address, jobs=options.jobs)
        return ray
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return InProcess() if on == "here" else Processes(options.jobs or cores)


def carry_out(study: "Study", options: StudyOptions, command: Sequence[str]) -> Path:
    """Run a study, or list its trials with --dry-run; print the results and return the study's directory.

    Args:
        command: the command line, beginning with the script, for the messages that say how to continue.
    """
    from cprl.studies import run_study

    executor = executor_of(options)
    if options.dry_run:
        return _list(study, options)
    run = partial(run_study, study, only=options.only or None, keep_checkpoints=options.keep_checkpoints)
    result = run_resumable(run, options, executor, command)
    say_result(result, command)
    return result.out


def run_resumable(
    run: "Callable[..., ResultT]", options: TrialOptions, executor: "Executor", command: Sequence[str]
) -> ResultT:
    """Run a study or a search. If Ctrl-C (SIGINT) or SIGTERM ends it, note the command that continues it."""
    program, *words = command_line(command)
    # The line that runs what is lacking, whole and as a summary has it, which names no place.
    again = quote_command([without_directories(program), *without_options(words, ["--only"])])
    where = {"out": options.out, "runs": options.runs}
    try:
        with ended_by_sigterm():
            return run(**where, on=executor, results=options.figures, last=options.last, again=again)
    except (KeyboardInterrupt, SystemExit) as error:
        error.add_note(f"To continue: {quote_command(typed_command_line(command))}")
        raise


def _list(study: "Study", options: StudyOptions) -> Path:
    """Print every trial and its state, write nothing, and return the study's directory."""
    from cprl.studies.run import trials_with
    from cprl.studies.status import BEAT_S
    from cprl.studies.study import RUNS, STATUS, directory_of
    from cprl.studies.trial_progress import Overview, progress_table
    from cprl.studies.trials import trials_of

    out = directory_of(study, options.out)
    runs = out / RUNS if options.runs is None else options.runs
    overview = Overview(trials_with(trials_of(study, runs), options.only or None), out / STATUS)
    now = overview.look()
    if now.counts["unfinished"]:  # those that run say something new within a second
        time.sleep(1.5 * BEAT_S)
        now = overview.look()
    width = None if sys.stdout.isatty() else 160
    console(width=width).print(progress_table(now, title=study.name))
    about = f"{len(study.all_conditions)} conditions ({', '.join(study.columns)}), {study.replicas} replicas"
    say(f"{about} each, in {runs}; nothing was written")
    return out


def say_result(result: "StudyResult", command: Sequence[str]) -> None:
    """Print the results of a study and where they are. Exit with code 1 if a trial failed or is damaged.

    For such a trial, the message says why, where to look, and what to do.
    """
    from cprl.studies.results import FIGURES
    from cprl.studies.tables.comparing import condition_table, without_unfinished
    from cprl.terminal.text_tables import print_tables

    if result.table is not None and result.table.metrics:
        print_tables([without_unfinished(condition_table(result.table))])
        for figure in sorted((result.out / FIGURES).glob("*.png")):
            say(f"Figure: {figure}")
    say(result.out)
    damaged = [run for run in result.table.missing_runs if run.is_damaged] if result.table is not None else []
    if damaged:
        numbers = f"{len(damaged)} of {len(result.trials)} trials"
        lines = [f"{numbers} cannot be read and are not in these results, in {result.runs}:"]
        say("\n".join([*lines, *(f"  {run}" for run in damaged)]))
    if result.failed:
        _say_failed(result, command)
    if result.failed or damaged:
        sys.exit(1)


def _say_failed(result: "StudyResult", command: Sequence[str]) -> None:
    """Print the trials that failed, with reasons, files to look at, and the command that tries again."""
    from cprl.studies.status import Status
    from cprl.studies.study import STATUS

    labels = {trial.name: trial.label for trial in result.trials}
    outcomes = {outcome.name: outcome for outcome in result.failed}
    kept = "; the others are kept" if len(outcomes) < len(labels) else ""
    lines = [f"{len(outcomes)} of {len(labels)} trials failed{kept}:"]
    for name, outcome in outcomes.items():
        status = Status(result.out / STATUS, name)
        where = status.failed if status.failed.exists() else status.log
        lines += [f"  {labels[name]}: {outcome.reason}", f"    {where}", f"    {outcome.command}"]
    say("\n".join([*lines, f"To try them again: {quote_command(typed_command_line(command))}"]))
