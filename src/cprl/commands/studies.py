"""`cprl sweep` and `cprl table`, and `study_main`: the command line of a recipe that describes a study."""

import importlib.util
import inspect
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import tyro

from cprl.arguments import BLOCK, LAST, WINDOW, integer
from cprl.commands.recipe import ended_by_sigterm, in_a_sentence, parse_with
from cprl.runs.files import refuse_to_write_over, write_atomically
from cprl.runs.recipe import read_recipe, runs_in, without_directories, without_options
from cprl.system.output import OUT, RESUMES, console, printed, say
from cprl.system.shipped import command_of, is_shipped, named_command, program_of, recipe_named

if TYPE_CHECKING:
    from cprl.experiment import Experiment
    from cprl.studies import Search, Study, StudyTable
    from cprl.studies.tables.comparing import Cells
if TYPE_CHECKING:
    from cprl.studies import Search, SearchResult, Study, StudyResult
    from cprl.studies.executors import Executor
    from cprl.studies.trials import Outcome, Trial

PROGRAM: Final = "cprl sweep"
_RECIPE: Final = (
    "A Python file with a function `experiment`, the name of a recipe (cprl recipe lists them), a "
    "recipe.json, or the directory of a run."
)
_MODULE: Final = "cprl_swept_recipe"
_TRAINING: Final = "training"
_TABLE_SUFFIXES: Final = (".parquet", ".csv", ".md")
Part = Literal["training", "evaluation", "random"]
_NOTE: Final = (
    "cprl sweep runs a recipe under several conditions. With --vary PATH=VALUES any value below is varied: "
    'commas stand between values, "x" or spaces between the numbers of one value (hidden-cells=32x32,64x64). '
    "agents.*.PATH means every agent that learns, agents.0.PATH one. Values may also be True, False, None, "
    "names, and boards by their names. With --draws or --search a range may stand in their place: "
    "uniform(LOW,HIGH), loguniform(LOW,HIGH) or integers(LOW,HIGH). Every other flag below is the same in "
    "all conditions; --replicas are those of each condition."
)


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


@dataclass(frozen=True, kw_only=True)
class SweepOptions(StudyOptions):
    """What is varied, and how it is run."""

    vary: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """PATH=VALUE,VALUE,... e.g. game.rules.freeze-steps=5,25,100; repeated, every combination is run."""
    draws: int | None = None
    """So many random combinations instead of all."""
    block: int = BLOCK
    """Replicas that one run trains side by side; with fewer, more processes share the work."""
    reference: str | None = None
    """The name of the condition that others are compared with, e.g. "freeze_steps=25"."""
    search: int | None = None
    """Find good values in so many points proposed by Optuna (extra "optuna"), instead of running all."""
    maximise: str | None = None
    """With --search: the metric that shall be high; by default collective_return."""
    minimise: str | None = None
    """With --search: the metric that shall be low."""
    over: Literal["evaluation", "training"] = "evaluation"
    """With --search: the episodes that count, those of the evaluation or the last 30 of the training."""
    sampler: Literal["tpe", "random", "gp"] = "tpe"
    """With --search: how points are proposed."""
    at_once: int = 4
    """With --search: points that are proposed together; a multiple of --jobs keeps all of them busy."""


@dataclass(frozen=True, kw_only=True)
class MainOptions(StudyOptions):
    """How a study is run."""

    replicas: int | None = None
    """Of each condition; by default those of the study."""
    episodes: int | None = None
    """Of each condition; by default those of the study."""
    block: int | None = None
    """Replicas that one run trains side by side; with fewer, more processes share the work."""


def study_main(study: "Study", argv: Sequence[str] | None = None) -> Path:
    """Runs a study as the command line asks for it; a recipe of a study ends with it.

    Args:
        argv: the command line, script first; by default that of this process.

    Returns:
        The study's directory.

    Raises:
        ValueError: where `argv` is no list of texts, or `study` no study.
        SystemExit: where the command line is refused, with the reason; with code 1 where trials failed, and
            130 or 143 where SIGINT (Ctrl-C) or SIGTERM interrupted it.
    """

    command = list(sys.argv if argv is None else argv)
    script = program_of(command[0])

    def read(options: Annotated[MainOptions, tyro.conf.arg(name="")] = MainOptions()) -> MainOptions:
        return options

    with in_a_sentence(script):
        options = tyro.cli(read, args=command[1:], prog=script, description=_about(study), config=_CONFIG)
        given = {own: getattr(options, own) for own in ("replicas", "block")}
        changed = {own: value for own, value in given.items() if value is not None}
        wanted = replace(study, **changed) if changed else study
        if options.episodes is not None:
            wanted = _of_episodes(wanted, options.episodes)
        return carry_out(wanted, options, command)


def _of_episodes(study: "Study", episodes: int) -> "Study":
    """A study with other episodes than its own."""
    shorter = replace(study, experiment=replace(study.experiment, episodes=episodes))
    for own in shorter.all_conditions:
        if own.experiment.episodes != episodes:
            raise ValueError(
                f"--episodes is {episodes}, and the study's condition {own.name} says "
                f"{own.experiment.episodes}; allowed: --episodes where no condition says how many"
            )
    return shorter


def sweep(words: Sequence[str], /) -> None:
    """Runs a recipe under several conditions, or searches for good values: cprl sweep RECIPE --vary ...

    Args:
        words: what stands after `cprl sweep`: first a Python file with a function `experiment`, the name of
            a recipe that comes with cprl, a recipe.json, or the directory of a run; then options.
    """
    if not words or words[0] in ("-h", "--help"):
        _print_help()
    if words[0].startswith("-"):
        raise ValueError(
            f"the first word after cprl sweep is {words[0]}; allowed: a recipe, e.g. cprl sweep "
            "recipes/commons.py --vary game.rules.freeze-steps=5,25,100"
        )
    source = recipe_named(words[0]).path if is_shipped(words[0]) else Path(words[0])
    allow = [after for word, after in pairwise(words) if word == "--allow"]
    allow += [word.removeprefix("--allow=") for word in words if word.startswith("--allow=")]
    sys.path[:0] = [str(source.resolve().parent)] if source.suffix == ".py" and source.is_file() else []
    sys.path[:0] = [os.getcwd()] if allow else []
    make = recipe_of(source, allow)
    program = f"{PROGRAM} {words[0]}"
    experiment, options = parse_with(make, words[1:], SweepOptions(), program=program, note=_NOTE)
    _refuse_arguments(options.vary, make)
    carry_out(wanted(experiment, options), options, ["cprl", "sweep", *words])


def _refuse_arguments(vary: Sequence[str], make_experiment: "Callable[..., Experiment]") -> None:
    """Raises a ValueError where an argument of the recipe is varied, and no field of the experiment."""
    from cprl.experiment import Experiment

    own = {*inspect.signature(make_experiment).parameters} - {field.name for field in fields(Experiment)}
    for word in vary:
        name = word.partition("=")[0].replace("-", "_")
        if name in own:
            raise ValueError(
                f"the path {name} matches nothing: {name} is an argument of the recipe, the same in all "
                "conditions; allowed: a field of the experiment, e.g. game.rules.freeze_steps"
            )


def wanted(experiment: "Experiment", options: SweepOptions) -> "Study | Search":
    """The study or search that a sweep is."""
    from cprl.studies import Search, Study
    from cprl.studies.factors import Distribution, factors_of

    if not options.vary:
        raise ValueError("nothing is varied; allowed: --vary PATH=VALUE,VALUE..., at least once")
    factors = factors_of(experiment, options.vary)
    how: dict[str, Any] = {"block": options.block}
    if options.search is None:
        for own in ("maximise", "minimise", *_OF_SEARCH):
            if getattr(options, own) != getattr(SweepOptions(), own):
                raise ValueError(f"--{own.replace('_', '-')} is for a search; allowed: with --search POINTS")
        ranges = [name for name, own in factors.items() if isinstance(own, Distribution)]
        if ranges and options.draws is None:
            raise ValueError(f"{ranges[0]} has a range; allowed: values, or a range with --draws or --search")
        return Study(experiment, factors, draws=options.draws, reference=options.reference, **how)
    for own in ("draws", "reference"):
        if getattr(options, own) is not None:
            raise ValueError(f"--{own} is not for a search; allowed: one of --{own} and --search")
    if options.maximise is not None and options.minimise is not None:
        raise ValueError("--maximise and --minimise are given; allowed: one of them")
    return Search(
        experiment,
        factors,
        points=options.search,
        metric=options.maximise or options.minimise or "collective_return",
        direction="maximise" if options.minimise is None else "minimise",
        **{own: getattr(options, own) for own in _OF_SEARCH},
        **how,
    )


def _print_help() -> None:
    """Prints what holds for every recipe, and ends the process."""

    def read(
        recipe: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(help=_RECIPE)],
        options: Annotated[SweepOptions, tyro.conf.arg(name="")] = _DEFAULTS,
    ) -> None:
        """Never called."""

    about = f"{_NOTE} The flags of a recipe are listed by cprl sweep RECIPE --help."
    tyro.cli(read, args=["--help"], prog=PROGRAM, description=about, config=_CONFIG)


def recipe_of(source: Path, allow: Sequence[str] = ()) -> "Callable[..., Experiment]":
    """What makes the experiment of a recipe.

    Args:
        source: a Python file with a function `experiment`, which is imported and not run; a recipe.json; or
            the directory of a run.
        allow: the user's own code, "module:Class", that a recipe.json may import.
    """
    if source.suffix != ".py" or source.is_dir():
        directory, kept = source if source.is_dir() else source.parent, read_recipe(source)

        from cprl.experiment import Experiment

        stored = Experiment.from_recipe(kept, allow=allow, directory=directory)

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


@dataclass(frozen=True, kw_only=True)
class Compare:
    """What of a table is compared."""

    metric: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """What is compared, e.g. collective_return; may be repeated."""
    part: Part = _TRAINING
    """Of the runs: their training, their agents in fresh worlds, or random play in these."""
    last: int | None = None
    """Episodes at the end of the training that are compared, by default 30."""

    def __post_init__(self) -> None:
        if self.last is not None and self.part != _TRAINING:
            raise ValueError(f"--last counts episodes of the training; allowed: without --part {self.part}")


def runs_table(
    runs: tuple[Path, ...],
    /,
    *,
    by: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    compare: Annotated[Compare, tyro.conf.arg(name="")] = Compare(),
    reference: str | None = None,
    window: int | None = None,
    out: Path | None = None,
    csv: bool = False,
    summary: bool = False,
    allow: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
) -> None:
    """Compares any runs, grouped by fields of their experiments, with intervals over replicas.

    Args:
        runs: directories of runs, or of directories that hold them, with --by; or the directory of a study.
        by: the path of a field, e.g. game.rules.freeze-steps, agents.*.algorithm.settings.gamma or name; may
            be repeated.
        reference: the name of the condition that others are compared with, e.g. freeze_steps=25; by default
            the first, or that of the study.
        window: episodes of a row of the table, of which --last compares whole ones, 10 by default; 1 for
            episodes one by one; with --by.
        out: a file to be: .parquet or .csv with every window of episodes, replica and metric, or .md with
            what is printed.
        csv: print every window of episodes, replica and metric as CSV, and nothing else.
        summary: write summary.md of a study again, from its table alone.
        allow: code of your own, module:Class, that a run's recipe may name; may be repeated.
    """
    if out is not None:
        if out.suffix not in _TABLE_SUFFIXES:
            raise ValueError(f"--out is {out}; allowed: a name that ends in {', '.join(_TABLE_SUFFIXES)}")
        refuse_to_write_over(out)
    if not runs:
        raise ValueError("cprl table wants at least one run: cprl table RUN... --by FIELD")
    if summary and by:
        raise ValueError("--summary is of a study; allowed: without --by, cprl table STUDY --summary")
    if by:
        runs_in(runs)

        from cprl.studies.tables.pooled import pooled_table

        window = WINDOW if window is None else window
        table = pooled_table(runs, by=by, window=window, reference=reference, allow=allow)
    else:
        table = _table_in(runs, reference, window)
    if csv:
        OUT.write(table.to_csv())
        return

    from cprl.studies.tables.comparing import rich_table

    last = LAST if compare.last is None else compare.last
    compared = _compared(table, compare.metric, compare.part, last)
    terminal = console(width=None if OUT.isatty() else 250)
    for cells in compared:
        terminal.print(rich_table(cells))
    say(str(table))
    if summary:
        from cprl.studies.results import write_summary

        say(f"Written: {write_summary(table, runs[0], last=last)}")
    if out is not None:
        _write(table, compared, out)
        say(f"Written: {out}")


def _table_in(runs: Sequence[Path], reference: str | None, window: int | None) -> "StudyTable":
    """The table of a study's directory."""
    from cprl.studies import StudyTable

    path = runs[0] / "table.parquet"
    if len(runs) > 1 or not path.exists():
        raise ValueError(
            "cprl table wants a field that tells runs apart: cprl table RUN... --by game.rules.freeze-steps; "
            "or the directory of one study with its table.parquet: cprl table STUDY"
        )
    if window is not None:
        raise ValueError("--window is for runs; allowed: with --by, as a study's table has its windows")
    table = StudyTable.read(path)
    if reference is None:
        return table
    if reference not in table.design.conditions:
        names = ", ".join(list(table.design.conditions)[:10])
        raise ValueError(f"--reference is {reference}; allowed: the name of a condition: {names}")
    return replace(table, design=replace(table.design, reference=reference))


def _compared(table: "StudyTable", metrics: Sequence[str], part: Part, last: int) -> "list[Cells]":
    """Levels, and differences where there is more than one condition."""
    from cprl.studies.tables.comparing import cells, compare, metrics_of

    comparisons = [compare(table, metric, part=part, last=last) for metric in metrics_of(table, metrics)]
    if not comparisons:
        return []
    several = len(table.design.conditions) > 1
    return [cells(comparisons), cells(comparisons, "differences")] if several else [cells(comparisons)]


def _write(table: "StudyTable", compared: "Sequence[Cells]", out: Path) -> None:
    if out.suffix == ".parquet":
        table.write(out)
        return
    content = table.to_csv()
    if out.suffix == ".md":
        from cprl.studies.tables.comparing import markdown

        lines = [line for cells in compared for line in (cells.heading, "", *markdown(cells))]
        content = "\n".join([*lines, *str(table).split("\n"), ""])
    out.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(out, lambda file: file.write(content.encode()))


def _about(study: "Study") -> str:
    parts = [study.question, f"Expected: {study.expectation}" if study.expectation else ""]
    names = ", ".join(own.name for own in study.all_conditions[:_LISTED])
    more = f" and {len(study.all_conditions) - _LISTED} more" if study.all_conditions[_LISTED:] else ""
    parts.append(f"{len(study.all_conditions)} conditions: {names}{more}; {study.replicas} replicas of each.")
    return "\n\n".join(filter(None, parts))


_LISTED: Final = 20
_CONFIG: Final = (tyro.conf.HelptextFromCommentsOff,)
_DEFAULTS: Final = SweepOptions()
_OF_SEARCH: Final = ("over", "sampler", "at_once")


_BEST: Final = 10
"""Points of a search that are printed."""


def executor_of(options: StudyOptions) -> "Executor":
    """Where trials are run."""
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
        command: the command line, script first, which is said where it can be used again.

    Returns:
        The study's directory.

    Raises:
        SystemExit: with code 1 where trials have failed, and 130 or 143 where it was interrupted.
    """
    from cprl.custom import trust
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
    trust(*options.allow)
    names = ("runs", "last")
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
    from cprl.studies.progress import Overview, table_of
    from cprl.studies.run import trials_with
    from cprl.studies.status import BEAT_S
    from cprl.studies.study import RUNS, STATUS, directory_of
    from cprl.studies.trials import trials_of

    study = Study(what.experiment, name=what.name) if isinstance(what, Search) else what
    out = directory_of(study, options.out)
    if isinstance(what, Search):
        factors = ", ".join(f"{name}: {own}" for name, own in what.factors.items())
        say(f"{what.points} points of {factors}, found one after the other, in {out}; nothing was written")
        return out
    trials = trials_with(trials_of(study), options.only)
    runs = out / RUNS if options.runs is None else options.runs
    overview = Overview(trials, runs, out / STATUS)
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
    from cprl.studies.status import Status
    from cprl.studies.study import STATUS

    trials: dict[str, Trial] = {trial.name: trial for trial in result.trials}
    outcomes: dict[str, Outcome] = {own.name: own for own in result.failed}
    lines = [f"{len(outcomes)} of {len(trials)} trials failed; the others are kept:"]
    for name, outcome in outcomes.items():
        status = Status(result.out / STATUS, name)
        where = status.failed if status.failed.exists() else status.log
        lines += [f"  {trials[name].label}: {outcome.reason}", f"    {where}", f"    {outcome.command}"]
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
