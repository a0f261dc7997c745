"""`cprl sweep` and `search`, and `study_main`: the command line of a recipe of a study."""

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
from cprl.commands.recipe import (
    ALLOW,
    Words,
    ended_by_sigterm,
    in_a_sentence,
    parse_with,
    trust_allowed,
    wrapped,
)
from cprl.runs.length import UNITS, without_length
from cprl.runs.recipe import read_recipe, without_directories, without_options
from cprl.system.defaults import LAST
from cprl.system.output import console, printed, say
from cprl.system.shipped import command_of, is_shipped, named_command, program_of, recipe_named
from cprl.values import Range, checked

if TYPE_CHECKING:
    from cprl.experiment import Experiment
    from cprl.studies import SearchResult, Study, StudyResult
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
_ABOUT: Final = {
    "cprl sweep": "Run a recipe under several conditions.",
    "cprl search": "Search for good values of a recipe's experiment by Optuna, point by point.",
}


@dataclass(frozen=True, kw_only=True)
class TrialOptions:
    """How trials are run and compared; nothing of it changes a run."""

    out: Path | None = None
    """The study's directory; by default studies/NAME. The same line continues a study that was stopped, and
    runs what is new in one that was changed."""
    runs: Path | None = None
    """The directory of the runs, which several studies may share; by default runs/ in the study's."""
    jobs: int | None = None
    """Trials that run at the same time."""
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
    block: int | None = None
    """Replicas that one run trains side by side, by default 8; with fewer, more processes share the work."""


@dataclass(frozen=True, kw_only=True)
class StudyOptions(TrialOptions):
    """How a study is run."""

    only: Words = ()
    """Run a condition alone, or those with some levels: "gamma=0.9", "gamma=0.9, freeze_steps=5"; may be
    repeated. The others stay as they are, so that several machines can share a study."""
    keep_checkpoints: bool = False
    """Keep the state of each training, buffers included (an agent's takes as much as its buffer), so that the
    same study with more --episodes goes on from there."""


@dataclass(frozen=True, kw_only=True)
class MainOptions(StudyOptions):
    """How the study of a recipe is run."""

    episodes: int | None = None
    """Of each condition; by default as many as the study says."""
    steps: int | None = None
    """Of each condition of a study that counts steps; by default as many as the study says."""
    replicas: int | None = None
    """Of each condition; by default as many as the study says."""


@dataclass(frozen=True, kw_only=True)
class SweepOptions(StudyOptions):
    """What is varied, and how it is run."""

    vary: Words = ()
    """PATH=VALUE,VALUE,... e.g. game.rules.freeze-steps=5,25,100; repeated, every combination is run."""
    draws: int | None = None
    """So many random combinations instead of all."""
    design: Literal["random", "latin_hypercube", "sobol"] = "random"
    """With --draws: how they are drawn, by chance or evenly."""
    reference: str | None = None
    """The name of the condition that others are compared with, e.g. "freeze_steps=25"."""


@dataclass(frozen=True, kw_only=True)
class SearchOptions(TrialOptions):
    """What is searched, and how it is run."""

    vary: Words = ()
    """PATH=VALUE,VALUE,... or PATH=loguniform(LOW,HIGH); may be repeated."""
    points: int = 30
    """How many points Optuna (extra "optuna") proposes."""
    metric: str = "collective_return"
    """The metric whose best value is searched."""
    direction: Literal["maximise", "minimise"] = "maximise"
    """Whether it should be high or low."""
    over: Literal["evaluation", "training"] = "evaluation"
    """Which episodes count: the evaluation, or the last 30 of the training."""
    sampler: Literal["tpe", "random", "gp"] = "tpe"
    """How points are proposed."""
    at_once: int = 4
    """Points that are proposed together; a multiple of --jobs keeps all of them busy."""


T = TypeVar("T")
RecipeOptions = TypeVar("RecipeOptions", SweepOptions, SearchOptions)


def study_main(study: "Study", argv: Sequence[str] | None = None) -> Path:
    """Run a study as the command line asks for it; a recipe of a study ends with it.

    Args:
        argv: the command line, script first; by default this process's.

    Returns:
        The study's directory.

    Raises:
        SystemExit: where the command line is refused, with the reason; with code 1 where trials failed, and
            130 or 143 where SIGINT (Ctrl-C) or SIGTERM interrupted it.
    """
    command = list(sys.argv if argv is None else argv)
    script = program_of(command[0])
    with in_a_sentence(script):
        words = trust_allowed(command[1:])
        options = tyro.cli(MainOptions, args=words, prog=script, description=_about(study), config=_CONFIG)
        changes = _given(options)
        said = {unit: changes.pop(unit) for unit in UNITS if unit in changes}
        if said:
            changes["experiment"] = replace(study.experiment, **without_length({}) | said)
        study = replace(study, **changes)
        for unit, number in said.items():
            for condition in study.all_conditions:
                if (stated := getattr(condition.experiment, unit)) != number:
                    raise ValueError(
                        f"--{unit} is {number}, and the study's condition {condition.name} says {stated}; "
                        f"allowed: --{unit} where no condition says how many"
                    )
        return carry_out(study, options, command)


def _given(options: TrialOptions) -> dict[str, Any]:
    """The options that are fields of a `Study` or `Search`: those that the class of these has itself."""
    names = {"block", *type(options).__annotations__} - {"vary"}
    return {name: value for name, value in vars(options).items() if name in names and value is not None}


def sweep(words: Sequence[str], /) -> None:
    """Run a recipe under several conditions: cprl sweep RECIPE --vary ...

    Args:
        words: what stands after `cprl sweep`: first a Python file with a function `experiment`, the name of
            a recipe that comes with cprl, a recipe.json, or the directory of a run; then options.
    """
    experiment, options = _read(words, SweepOptions(), "cprl sweep")

    from cprl.studies import Study
    from cprl.studies.factors import factors_of

    study = Study(experiment, factors_of(experiment, options.vary), **_given(options))
    carry_out(study, options, ["cprl", "sweep", *words])


def search(words: Sequence[str], /) -> None:
    """Search for good values by Optuna: cprl search RECIPE --vary ... --points 30

    Args:
        words: what stands after `cprl search`, see `sweep`.
    """
    experiment, options = _read(words, SearchOptions(), "cprl search")

    from cprl.studies import Search, run_search
    from cprl.studies.factors import factors_of
    from cprl.studies.study import directory_of

    wanted = Search(experiment, factors_of(experiment, options.vary), **_given(options))
    command = ["cprl", "search", *words]
    executor = executor_of(options)
    if options.dry_run:
        factors = ", ".join(f"{name}: {factor}" for name, factor in wanted.factors.items())
        out = directory_of(wanted.study_of([]), options.out)
        say(f"{wanted.points} points of {factors}, found one after the other, in {out}; nothing was written")
        return
    result = _run(partial(run_search, wanted), options, executor, command)
    _say_best(result)
    _say_result(result, command)


def _read(words: Sequence[str], options: RecipeOptions, program: str) -> "tuple[Experiment, RecipeOptions]":
    """The experiment of a recipe and the options that stand after it; prints the help that they ask for."""
    words = trust_allowed(words)
    if not words or words[0] in ("-h", "--help"):
        _print_help(options, program)
    if words[0].startswith("-"):
        raise ValueError(
            f"the first word after {program} is {words[0]}; allowed: a recipe, e.g. {program} "
            "recipes/commons.py --vary game.rules.freeze-steps=5,25,100"
        )
    source = recipe_named(words[0]).path if is_shipped(words[0]) else Path(words[0])
    sys.path[:0] = [str(source.resolve().parent)] if source.suffix == ".py" and source.is_file() else []
    note = f"{_ABOUT[program]} {_NOTE}"
    experiment, options = parse_with(
        recipe_of(source), words[1:], options, program=f"{program} {words[0]}", note=note
    )
    if not options.vary:
        raise ValueError("nothing is varied; allowed: --vary PATH=VALUE,VALUE..., at least once")
    return experiment, options


def _print_help(options: RecipeOptions, program: str) -> None:
    kind: Any = type(options)

    def read(
        recipe: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(help=_RECIPE)],
        options: Annotated[kind, tyro.conf.arg(name="")] = options,
    ) -> None:
        """Never called."""

    listed = f"The flags of a recipe are listed by {program} RECIPE --help."
    about = "\n\n".join([_ABOUT[program], _NOTE, listed, ALLOW])
    tyro.cli(
        with_help(read),
        args=["--help"],
        prog=program,
        description=wrapped(about),
        config=(*_CONFIG, tyro.conf.DisallowNone),
    )


def recipe_of(source: Path) -> "Callable[..., Experiment]":
    """What makes the experiment of a recipe: a Python file with a function `experiment`, which is imported
    and not run; a recipe.json; or the directory of a run."""
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
    made: Callable[..., Experiment] | None = getattr(module, "experiment", None)
    if not callable(made):
        if hasattr(module, "STUDY"):
            line = printed(["python", str(source)])
            raise ValueError(f"{source} describes a study, which is run by itself: {line}")
        raise ValueError(f"{source} has no function `experiment`; allowed: one that gives an Experiment")
    return made


def _about(study: "Study") -> str:
    conditions = study.all_conditions
    names = ", ".join(condition.name for condition in conditions[:_LISTED])
    more = f" and {len(conditions) - _LISTED} more" if conditions[_LISTED:] else ""
    parts = [
        study.question,
        f"Expected: {study.expectation}" if study.expectation else "",
        f"{len(conditions)} conditions: {names}{more}; {study.replicas} replicas of each.",
        ALLOW,
    ]
    return "\n\n".join(filter(None, parts))


_LISTED: Final = 20
"""Conditions that `--help` of a study names."""
_BEST: Final = 10
"""Points of a search that are printed."""
_CONFIG: Final = (tyro.conf.HelptextFromCommentsOff,)


def executor_of(options: TrialOptions) -> "Executor":
    from cprl.studies.executors import InProcess, Processes, Ray

    jobs = 1 if options.jobs is None else checked("--jobs", options.jobs, Annotated[int, Range(1, 4096)])
    on = options.on or ("processes" if jobs > 1 else "here")
    if options.address is not None and on != "ray":
        raise ValueError(f"--address is for --on ray, and this is --on {on}; allowed: one with the other")
    if on == "here" and jobs > 1:
        raise ValueError(f"--jobs is {jobs} with --on here; allowed: 1, or --on processes")
    if on == "ray":
        return Ray(options.address, jobs=options.jobs)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return InProcess() if on == "here" else Processes(options.jobs or cores)


def carry_out(study: "Study", options: StudyOptions, command: Sequence[str]) -> Path:
    """Run a study as the command line, script first, asks for it, print its results, and return its
    directory."""
    from cprl.studies import run_study

    executor = executor_of(options)
    if options.dry_run:
        return _list(study, options)
    run = partial(run_study, study, only=options.only or None, keep_checkpoints=options.keep_checkpoints)
    result = _run(run, options, executor, command)
    _say_result(result, command)
    return result.out


def _run(run: "Callable[..., T]", options: TrialOptions, executor: "Executor", command: Sequence[str]) -> T:
    """Run a study or a search; note what continues it where Ctrl-C (SIGINT) or SIGTERM ends it."""
    program, *words = named_command(command)
    # The line that runs what is lacking, whole and as a summary has it, which names no place.
    again = printed([without_directories(program), *without_options(words, ["--only"])])
    out = options.out
    runs = options.runs
    results = options.figures
    last = options.last
    try:
        with ended_by_sigterm():
            return run(out, on=executor, runs=runs, results=results, last=last, again=again)
    except (KeyboardInterrupt, SystemExit) as error:
        error.add_note(f"To continue: {printed(command_of(command))}")
        raise


def _list(study: "Study", options: StudyOptions) -> Path:
    from cprl.studies.progress import Overview, table_of
    from cprl.studies.run import trials_with
    from cprl.studies.status import BEAT_S
    from cprl.studies.study import RUNS, STATUS, directory_of
    from cprl.studies.trials import trials_of

    out = directory_of(study, options.out)
    runs = out / RUNS if options.runs is None else options.runs
    overview = Overview(trials_with(trials_of(study, runs), options.only or None), runs, out / STATUS)
    now = overview.look()
    if now.counts["unfinished"]:  # those that run say something new within a second
        time.sleep(1.5 * BEAT_S)
        now = overview.look()
    console(width=None if sys.stdout.isatty() else 160).print(table_of(now, title=study.name))
    about = f"{len(study.all_conditions)} conditions ({', '.join(study.columns)}), {study.replicas} replicas"
    say(f"{about} each, in {runs}; nothing was written")
    return out


def _say_best(result: "SearchResult") -> None:
    wanted = result.search
    best = "highest" if wanted.direction == "maximise" else "lowest"
    say(f"{wanted.name}: {len(result.points)} points; the {best} {wanted.metric}, means over replicas:")
    for point in result.ranked[:_BEST]:
        say(f"  {point.value:10.6g}  {point.name}")
    refused = [point for point in result.points if point.reason]
    if refused:
        say(f"  {len(refused)} points were refused, e.g. {refused[0].name}: {refused[0].reason}")


def _say_result(result: "StudyResult", command: Sequence[str]) -> None:
    """Prints the results of a study, and where they are; of trials that failed or are damaged why, where to
    look and what to do, and exits."""
    from cprl.studies.results import FIGURES
    from cprl.studies.tables.comparing import cells, of_finished
    from cprl.terminal.tables import show

    if result.table is not None and result.table.metrics:
        show([of_finished(cells(result.table))])
        for figure in sorted((result.out / FIGURES).glob("*.png")):
            say(f"Figure: {figure}")
    say(result.out)
    damaged = [run for run in result.table.lacking if run.is_damaged] if result.table is not None else []
    if damaged:
        numbers = f"{len(damaged)} of {len(result.trials)} trials"
        lines = [f"{numbers} cannot be read and are not in these results, in {result.runs}:"]
        say("\n".join([*lines, *(f"  {run}" for run in damaged)]))
    if result.failed:
        _say_failed(result, command)
    if result.failed or damaged:
        sys.exit(1)


def _say_failed(result: "StudyResult", command: Sequence[str]) -> None:
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
    say("\n".join([*lines, f"To try them again: {printed(command_of(command))}"]))
