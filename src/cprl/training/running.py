"""run: one experiment from its learners to its report: train, save, evaluate in fresh worlds, summarise."""

import shutil
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext, suppress
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import pyarrow as pa
import torch
from torchrl.envs import EnvBase

from cprl.commons.threads import MOST_THREADS
from cprl.envs.state import transforms_state
from cprl.envs.unwrap import agent_names
from cprl.experiment import Experiment
from cprl.measuring.episodes import Episode, own_name, try_own_metrics
from cprl.measuring.table import labelled, naming, where
from cprl.population import exploration_steps, partners_in
from cprl.runs.checkpoints import (
    FOLDER,
    KEEPS_NO_STATE,
    REPORT,
    Checkpointer,
    checkpoints_in,
    extend,
    is_ending,
    refuse_to_extend,
)
from cprl.runs.episodes import EpisodeTable, table_of
from cprl.runs.files import LOCK_FILE, RunLockedError, refuse_missing, write_json
from cprl.runs.length import Length
from cprl.runs.loggers import LoggerCallback, check_logger, make_logger
from cprl.runs.recipe import (
    RECIPE_FILE,
    read_recipe,
    refuse_another_run,
    say_changes,
    start_run,
    write_circumstances,
    write_metrics,
    write_on_nan,
)
from cprl.runs.weights import (
    DECISIONS,
    TRANSFORMS,
    partners_of,
    save_beside_weights,
    save_weights,
    weights_of,
)
from cprl.system.compiling import cleared_up
from cprl.system.output import RESUMES, console, say
from cprl.system.process import prepare_process
from cprl.system.times import Times
from cprl.system.working import working
from cprl.terminal.figures import training_curve
from cprl.terminal.progress import ProgressBar
from cprl.terminal.summary import summarise
from cprl.training.agents import Population
from cprl.training.course import NEEDED, course_of
from cprl.training.finite import summary
from cprl.training.outcome import (
    Evaluations,
    evaluate_population,
    exhibited,
    make_agents,
    random_play,
    write_evaluation,
)
from cprl.training.training import Training, check_callbacks, train
from cprl.values import Custom, Range, checked, made
from cprl.viewer.page import check_watch

if TYPE_CHECKING:
    from cprl.viewer.callback import ViewerCallback


@cleared_up()
def run(
    experiment: Experiment,
    out: Path | str | None = None,
    *,
    resume: bool = False,
    take_over: bool = False,
    keep_checkpoint: bool = False,
    watch: str = "file",
    linger: bool = False,
    threads: int = 1,
    callbacks: Sequence[object] = (),
    figures: bool = True,
) -> Path:
    """Train the agents of all replicas, evaluate them in fresh worlds, and write and print the outcome.

    A run that ends before its training has begun leaves nothing behind; later, all that it produced.

    Args:
        out: the directory of the run, new or empty; by default `runs/<name>-<time>`.
        resume: whether the run in `out`, which was stopped, is resumed from its newest checkpoint, or a run
            of fewer episodes, stopped or finished, is extended. Either equals a run that was not interrupted,
            bit for bit. Of a finished run of as many episodes nothing is done.
        take_over: whether to resume a run that a process on another host has locked.
        keep_checkpoint: whether a finished run keeps the state of its training, so that it can be extended:
            hundreds of megabytes, buffers included.
        watch: "file" for a recording for the Rerun viewer; "serve" or "spawn" to watch
            live as well, see `cprl.viewer.live.Live`; "off" for none.
        linger: whether the recording stays served after the run, until Ctrl-C (SIGINT) or SIGTERM; only with
            `watch` "serve" or "spawn".
        threads: torch's threads. Several are faster for large minibatches of many worlds, if no other
            program wants the cores; numbers then differ in their last bits.
        callbacks: further callbacks of this process (see `cprl.training.Callback`), which the recipe does
            not hold; they may look, and change nothing.
        figures: whether the training curve is drawn; a study draws its own.

    Returns:
        The directory, now with `recipe.json`, `episodes.parquet`, `run.rrd`, `checkpoints/final.pt`,
        `evaluation/`, `figures/`, `manifest.json` with their checksums, and `report.json`.

    Raises:
        RunLockedError: where another process writes the run.
        KeyboardInterrupt: after the first SIGINT (Ctrl-C), when the state is saved and the line that resumes
            is said; the second ends the process at once.
        SystemExit: with code 143 after SIGTERM, likewise.
        FileExistsError: where `out` is not empty and `resume` is not given.
        OSError: for a full disk or a deleted directory; the message names it. What was written before is
            intact, and the run can be resumed.
    """
    times = Times()
    check_watch(watch, linger=linger)
    for logger in experiment.loggers:
        check_logger(logger.resolve() if isinstance(logger, Custom) else logger)
    threads = checked("threads", threads, Annotated[int, Range(1, MOST_THREADS)])
    prepare_process(experiment.seed, threads=threads)
    out = None if out is None else Path(out)
    is_new = out is None or not out.exists()
    resumed = out if resume else None
    is_begun = resumed is not None and bool(checkpoints_in(resumed / FOLDER))
    weights = {} if resumed is None else _weights_of_partners(experiment, resumed)
    with working("making agents"):
        env, population = make_agents(experiment, starts=not is_begun, weights=weights)
    observers: list[Any] = [*(made(callback) for callback in experiment.callbacks), *callbacks]
    check_callbacks(observers)
    words = try_own_metrics(experiment.metrics, env)
    length = refuse_another_run(out, experiment.to_recipe, Experiment) if resume else experiment.length
    is_shorter = length.is_shorter_than(experiment.length)
    if resumed is not None and not is_shorter and (resumed / REPORT).exists():
        _tidy_up(resumed, experiment, keep_checkpoint=keep_checkpoint, take_over=take_over)
        return resumed
    directory = _start(experiment, out) if resumed is None else resumed
    if is_shorter:
        refuse_to_extend(directory, None if length.is_of_steps else length.number, observers)
    checkpointer = Checkpointer(directory, keep_ending=keep_checkpoint, take_over=take_over)
    closing = ExitStack()  # of the viewer, which outlives the rest
    try:
        with checkpointer:
            if resume:
                _begin_again(directory, experiment, is_begun=is_begun, length=length)
            write_metrics(directory, words)
            viewer = closing.enter_context(_make_viewer(watch, directory, experiment, env, population))
            work = _Work(directory, experiment, env, population, viewer, resume)
            _carry_out(work, observers, checkpointer, times, figures=figures)
    except BaseException as error:
        closing.close()
        if checkpointer.has_begun or (resume and isinstance(error, OSError)):
            error.add_note(f"{RESUMES}{checkpointer.resume_command}")
        elif not resume and not isinstance(error, RunLockedError):
            _remove(directory, with_directory=is_new)
            if isinstance(error, KeyboardInterrupt | SystemExit):
                say("Stopped before the training began: nothing was written.")
        elif resume and isinstance(error, KeyboardInterrupt | SystemExit):
            say(f"{RESUMES}{checkpointer.resume_command}")
        raise
    with closing:
        for callback in observers:
            if hasattr(callback, "on_finished"):
                callback.on_finished(directory)
        if linger and viewer is not None:
            viewer.linger()
    return directory


class _Work(NamedTuple):
    directory: Path
    experiment: Experiment
    env: EnvBase
    population: Population
    viewer: "ViewerCallback | None"
    resumes: bool


def _start(experiment: Experiment, out: Path | None) -> Path:
    def recipe_in(directory: Path) -> dict[str, Any]:
        return {**experiment.to_recipe(directory), **partners_of(directory, partners_in(experiment.agents))}

    return start_run(out, experiment.name, recipe_in)


def _carry_out(
    work: _Work, observers: Sequence[Any], checkpointer: Checkpointer, times: Times, *, figures: bool
) -> None:
    random = None
    if work.viewer is not None:
        random = random_play(work.experiment, work.population, seen=work.viewer.seen_at_random)
        work.viewer.random_play(random)
    training = _train(work, observers, checkpointer)
    played = _evaluate(work, random)
    table = _table(work, played)
    figure = _draw(work.experiment, work.directory, training, table) if figures else None
    _write_report(work.directory, training, times)
    _summarise(work, training, table, figure)
    checkpointer.done()
    _say_what_is_kept(work.directory, work.experiment)


def _train(work: _Work, observers: Sequence[Any], checkpointer: Checkpointer) -> Training:
    """Trains with the callbacks that write the table of episodes, show the progress and write to loggers, and
    saves what was learned."""
    directory, experiment, env, population, viewer, _ = work
    watching = [] if viewer is None else [viewer]
    with ExitStack() as stack:
        table = stack.enter_context(EpisodeTable(directory / "episodes.parquet", resumable=True))
        bar = stack.enter_context(ProgressBar.of(experiment))
        loggers = [make_logger(made(logger), directory) for logger in experiment.loggers]
        logging = [LoggerCallback(logger, resumes=work.resumes) for logger in loggers]
        evaluations = Evaluations(directory, experiment, env, population)
        training = train(
            env,
            population.learners,
            others=population.others,
            decisions=population.decisions,
            episodes=experiment.episodes,
            steps=experiment.steps,
            worlds=experiment.worlds,
            callbacks=[evaluations, table, bar, *observers, *watching, *map(stack.enter_context, logging)],
            checkpointer=checkpointer,
            update_every=experiment.update_every,
            on_nan=experiment.on_nan,
            metrics=experiment.metrics,
        )
        save_weights(directory, population.networks())
        save_beside_weights(directory, TRANSFORMS, transforms_state(env))
        if population.decisions is not None:
            save_beside_weights(directory, DECISIONS, population.decisions.learned())
    return training


def _evaluate(work: _Work, random: list[Episode] | None) -> dict[str, list[Episode]]:
    if work.viewer is not None:
        work.viewer.flush()
    played = evaluate_population(work.experiment, work.env, work.population, random=random)
    write_evaluation(work.directory, played, replicas=work.experiment.replicas)
    if work.viewer is not None:
        work.viewer.finished(played)
    return played


def _table(work: _Work, played: Mapping[str, list[Episode]]) -> pa.Table:
    """Return the episodes of the evaluation as one table, labelled by "policy": random play, and
    trained, where any agent learns, with the probability with which those with action values explore;
    others draw from a policy."""
    learners = work.population.learners.values()
    chances = {learner.settings.epsilon_evaluation for learner in learners if not learner.actor.stochastic}
    trained = "trained" + "".join(f", epsilon {chance:g}" for chance in sorted(chances))
    columns = {"random": played["random"], trained if learners else "agents": played["trained"]}
    replicas = range(work.experiment.replicas)
    table = pa.concat_tables(
        labelled(table_of(episodes, replicas), policy=name) for name, episodes in columns.items()
    )
    return naming(table, agent_names(work.env))


@working("drawing the training curve")
def _draw(experiment: Experiment, directory: Path, training: Training, played: pa.Table) -> Path | None:
    if not all(training.episodes_by_replica):
        say(f"No training curve: a replica has ended no episode in {training.steps:,} steps")
        return None
    steps = exploration_steps(experiment.agents)
    ends = None if steps is None else steps / experiment.worlds
    random = where(played, policy="random")
    return training_curve(directory, title=_title(experiment), random=random, exploration_turns=ends)


def _write_report(directory: Path, training: Training, times: Times) -> None:
    """Writes `report.json`, the sign that a run is finished."""
    length = training.length
    episodes = training.episodes_by_replica if length.is_of_steps else length.number
    report: dict[str, Any] = {
        **times.report(training.times),
        "steps": training.steps,
        "finished": datetime.now().astimezone().isoformat(timespec="seconds"),
        "episodes": episodes,
        "worlds": training.worlds,
        "threads": torch.get_num_threads(),
    }
    if training.finite.reported:
        report["not_finite"] = [asdict(finding) for finding in training.finite.reported]
    write_json(directory / REPORT, report)


def _summarise(work: _Work, training: Training, played: pa.Table, figure: Path | None) -> None:
    """Print the outcome."""
    notes = filter(None, (summary(training.finite.reported), work.experiment.own_code))
    has_course = all(training.episodes_by_replica) and set(NEEDED) <= set(played.column_names)
    summarise(
        work.directory,
        title=_title(work.experiment),
        played=played,
        course=course_of(work.directory, work.experiment.agents) if has_course else "",
        figure=figure,
        note="\n".join(notes) or None,
    )


def _title(experiment: Experiment) -> str:
    return f"{experiment.name}, {experiment.trained_in}, {experiment.length}"


def _weights_of_partners(experiment: Experiment, run: Path) -> dict[str, str]:
    """The names of the weights of `Frozen` agents that played when a run began, by their run."""
    partners = partners_in(experiment.agents)
    recipe = read_recipe(run) if partners and (run / RECIPE_FILE).exists() else {}
    names = {partner: weights_of(recipe, run, partner) for partner in partners}
    return {partner: name for partner, name in names.items() if name is not None}


def _begin_again(directory: Path, experiment: Experiment, *, is_begun: bool, length: Length) -> None:
    """Says what is new since a run was begun, of such a length, and writes it into its recipe."""
    say_changes(directory, write_circumstances(directory))
    if not is_begun:
        say("No checkpoint yet: begins with the first episode")
    write_on_nan(directory, experiment.on_nan)
    if length.is_shorter_than(experiment.length):
        extend(directory, length, experiment.length)


def _make_viewer(
    watch: str, directory: Path, experiment: Experiment, env: EnvBase, population: Population
) -> "AbstractContextManager[ViewerCallback | None]":
    if watch == "off":
        return nullcontext()
    from cprl.viewer.callback import ViewerCallback

    recipe = read_recipe(directory)
    circumstances = {name: recipe.get(name) for name in ("command", "started", "git", "versions")}
    return ViewerCallback(
        directory,
        env,
        title=_title(experiment),
        episodes=experiment.length.episodes,
        is_about=experiment.length.is_of_steps,
        worlds=experiment.worlds,
        metrics=[own_name(metric) for metric in experiment.metrics],
        recipe={**recipe["experiment"], **circumstances},
        live=None if watch == "file" else watch,
        exhibited=None if watch == "file" else exhibited(experiment, env, population),
    )


def _tidy_up(finished: Path, experiment: Experiment, *, keep_checkpoint: bool, take_over: bool) -> None:
    """Says that a run is finished, and tidies up if its process died before it had."""
    refuse_missing(finished)
    if (finished / LOCK_FILE).exists():
        with Checkpointer(finished, keep_ending=keep_checkpoint, take_over=take_over) as checkpointer:
            checkpointer.done()
    keeps_state = any(map(is_ending, checkpoints_in(finished / FOLDER)))
    more = f"with more {experiment.length.flag} it is extended" if keeps_state else KEEPS_NO_STATE
    text = f"{finished} is finished; {more}"
    console().print(text, soft_wrap=True)


def _remove(directory: Path, *, with_directory: bool) -> None:
    with suppress(OSError):
        for path in directory.iterdir():
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()
        if with_directory:
            directory.rmdir()


def _say_what_is_kept(directory: Path, experiment: Experiment) -> None:
    for checkpoint in checkpoints_in(directory / FOLDER):
        size = checkpoint.stat().st_size / 1e6
        text = f"Kept to extend it by --resume with more {experiment.length.flag}: {FOLDER}/ending-*.pt"
        console().print(f"{text}, {size:,.0f} MB", style="dim", highlight=False, soft_wrap=True)
