"""run: one experiment from its learners to its report: train, save, evaluate in fresh worlds, summarise."""

import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext, suppress
from dataclasses import asdict, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import pyarrow as pa
import torch
from torchrl.envs import EnvBase

from cprl.commons.threads import MOST_THREADS
from cprl.envs.state import transforms_state
from cprl.envs.unwrap import agent_names
from cprl.experiment import Experiment
from cprl.experiment.engine import about_engine, begun_with, engine_of
from cprl.measuring.episodes import Episode, try_own_metrics
from cprl.measuring.table import labelled, naming, where
from cprl.population import exploration_steps, partners_in
from cprl.runs.checkpoints import FOLDER, Checkpointer, checkpoints_in, endings_of
from cprl.runs.episodes import EpisodeTable
from cprl.runs.files import LOCK_FILE, REPORT, RunLockedError, refuse_missing, write_json
from cprl.runs.length import Length
from cprl.runs.loggers import LoggerCallback, check_logger, make_logger
from cprl.runs.recipe import (
    refuse_another_run,
    say_changes,
    write_circumstances,
    write_metrics,
    write_on_nan,
)
from cprl.runs.states import (
    KEEPS_NO_STATE,
    State,
    Step,
    extend,
    next_step,
    refuse_to_extend,
    start,
    state_of,
)
from cprl.runs.weights import (
    DECISIONS,
    TRANSFORMS,
    save_beside_weights,
    save_weights,
    weights_that_played,
)
from cprl.system.compiling import cleared_up
from cprl.system.output import RESUMES, console, say
from cprl.system.process import prepare_process
from cprl.system.times import Times
from cprl.system.working import working
from cprl.terminal.course import NEEDED, course_of
from cprl.terminal.figures import training_curve
from cprl.terminal.progress import ProgressBar
from cprl.terminal.summary import summarise
from cprl.training.agents import Population
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

    A run that ends before its training has begun leaves nothing behind; later, all that it produced. With
    `resume`, what is done depends on what `out` says, see `cprl.runs.states`:

    | it has                 | it is    | as many episodes, or steps  | more of them                 |
    |------------------------|----------|-----------------------------|------------------------------|
    | recipe.json            | begun    | resume: from the first step | extend: resume, to be longer |
    | checkpoints/training-* | stopped  | resume: from the newest     | extend: resume, to be longer |
    | report.json            | finished | tidy: say that it is        | extend: from its ending-*    |

    Args:
        out: the directory of the run, new or empty; by default `runs/<name>-<time>`.
        resume: whether the run in `out`, which was stopped, is resumed from its newest checkpoint, or a run
            of fewer episodes, stopped or finished, is extended. Either equals, bit for bit, a run that was
            not interrupted, by the engine with which it began: with engine="auto" a longer run may begin
            with another. Of a finished run of as many episodes nothing is done.
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
    _prepare(experiment, watch, linger=linger, threads=threads)
    out = None if out is None else Path(out)
    is_new = out is None or not out.exists()
    resumed = out if resume else None
    asked = experiment
    experiment = _with_engine(experiment, resumed)
    state, length, step = _due(out, experiment, resume=resume)
    with working("making agents"):
        partners = partners_in(experiment.agents)
        weights = {} if resumed is None else weights_that_played(resumed, partners)
        env, population = make_agents(experiment, starts=state in ("missing", "begun"), weights=weights)
    observers: list[Any] = [*map(made, experiment.callbacks), *callbacks]
    check_callbacks(observers)
    words = try_own_metrics(experiment.metrics, env)
    directory = start(out, experiment, partners) if resumed is None else resumed
    if step == "tidy" and not (directory / LOCK_FILE).exists():
        return _is_finished(directory, experiment)
    checkpointer = Checkpointer(directory, keep_ending=keep_checkpoint, take_over=take_over)
    with ExitStack() as closing:  # of the viewer, which outlives the rest
        with _left_behind(checkpointer, closing, step, is_new=is_new), checkpointer:
            # Another process may have finished or extended the run meanwhile.
            state, length, step = _due(out, experiment, resume=resume)
            if step == "tidy":
                _is_finished(directory, experiment)
                checkpointer.done()
                return directory
            if step == "extend":
                refuse_to_extend(directory, length, observers)
            if step != "start":
                _begin_again(directory, experiment, state, length)
            _say_engine(asked, experiment, state)
            write_metrics(directory, words)
            viewer = closing.enter_context(_make_viewer(watch, directory, experiment, env, population))
            watching = [] if viewer is None else [viewer]
            random = _play_at_random(experiment, population, viewer)
            with _loggers(experiment, directory, resumes=resume) as loggers:
                seeing = [*observers, *watching, *loggers]
                training = _train(experiment, directory, env, population, seeing, checkpointer)
            played = _evaluate(experiment, directory, env, population, viewer, random)
            table = _table(env, population, played)
            figure = _draw(experiment, directory, training, table) if figures else None
            _write_report(directory, training, times)
            _summarise(experiment, directory, training, table, figure)
            checkpointer.done()
            _say_what_is_kept(experiment, directory)
        for callback in observers:
            if hasattr(callback, "on_finished"):
                callback.on_finished(directory)
        if linger and viewer is not None:
            viewer.linger()
    return directory


def _with_engine(experiment: Experiment, resumed: Path | None) -> Experiment:
    """Return an experiment with the engine that trains it in place of "auto": the one with which the run
    began that is resumed or extended, so that its numbers are those of a whole run by that engine."""
    if experiment.engine != "auto":
        return experiment
    begun = None if resumed is None else begun_with(resumed)
    return replace(experiment, engine=begun or engine_of(experiment))


def _say_engine(asked: Experiment, experiment: Experiment, state: State) -> None:
    """Says which engine "auto" stands for, of a training that begins, or one that began with another."""
    if asked.engine != "auto":
        return
    if experiment.engine != engine_of(asked):
        say(f'Trains with engine="{experiment.engine}", as the run began.')
    elif state in ("missing", "begun") and (sentence := about_engine(asked)):
        say(sentence)


def _due(out: Path | None, experiment: Experiment, *, resume: bool) -> tuple[State, Length, Step]:
    """Return what the directory of a run says, how long the run is so far, and what is to be done there."""
    if not resume:
        return "missing", experiment.length, "start"
    length = refuse_another_run(out, experiment.to_recipe, Experiment)
    state = state_of(out)
    return state, length, next_step(state, length, experiment.length)


def _prepare(experiment: Experiment, watch: str, *, linger: bool, threads: int) -> None:
    """Refuses what nobody could watch or log to, and prepares the process."""
    check_watch(watch, linger=linger)
    for logger in experiment.loggers:
        check_logger(logger.resolve() if isinstance(logger, Custom) else logger)
    threads = checked("threads", threads, Annotated[int, Range(1, MOST_THREADS)])
    prepare_process(experiment.seed, threads=threads)


def _begin_again(run: Path, experiment: Experiment, state: State, length: Length) -> None:
    """Says what is new since a run was begun that is so long, and writes it into its recipe."""
    say_changes(run, write_circumstances(run))
    if state == "begun":
        say("No checkpoint yet: begins with the first episode")
    write_on_nan(run, experiment.on_nan)
    if length.is_shorter_than(experiment.length):
        extend(run, length, experiment.length)


def _is_finished(run: Path, experiment: Experiment) -> Path:
    """Says that a run is finished, and what it lost since."""
    refuse_missing(run)
    more = f"with more {experiment.length.flag} it is extended" if endings_of(run) else KEEPS_NO_STATE
    console().print(f"{run} is finished; {more}", soft_wrap=True)
    return run


@contextmanager
def _left_behind(
    checkpointer: Checkpointer, closing: ExitStack, step: Step, *, is_new: bool
) -> Iterator[None]:
    """What an error in the block leaves: of a training that has begun everything, and the line that resumes
    it; of a run that was to start nothing, not even its directory if that is new."""
    resumes = f"{RESUMES}{checkpointer.resume_command}"
    try:
        yield
    except BaseException as error:
        closing.close()
        is_stopped = isinstance(error, KeyboardInterrupt | SystemExit)
        if checkpointer.has_begun or (step != "start" and isinstance(error, OSError)):
            error.add_note(resumes)
        elif step != "start" and is_stopped:
            say(resumes)
        elif step == "start" and not isinstance(error, RunLockedError):
            _remove(checkpointer.run, with_directory=is_new)
            if is_stopped:
                say("Stopped before the training began: nothing was written.")
        raise


def _remove(directory: Path, *, with_directory: bool) -> None:
    with suppress(OSError):
        for path in directory.iterdir():
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()
        if with_directory:
            directory.rmdir()


def _play_at_random(
    experiment: Experiment, population: Population, viewer: "ViewerCallback | None"
) -> list[Episode] | None:
    """Shows in the viewer what random play gets, with which the training is compared; None without one."""
    if viewer is None:
        return None
    episodes = random_play(experiment, population, seen=viewer.seen_at_random)
    viewer.random_play(episodes)
    return episodes


@contextmanager
def _loggers(experiment: Experiment, directory: Path, *, resumes: bool) -> Iterator[list[LoggerCallback]]:
    """Within the block the experiment's loggers are open."""
    with ExitStack() as stack:
        loggers = [make_logger(made(logger), directory) for logger in experiment.loggers]
        yield [stack.enter_context(LoggerCallback(logger, resumes=resumes)) for logger in loggers]


def _train(
    experiment: Experiment,
    directory: Path,
    env: EnvBase,
    population: Population,
    callbacks: Sequence[Any],
    checkpointer: Checkpointer,
) -> Training:
    """Trains, writes the table of episodes and shows the progress meanwhile, and saves what was learned."""
    evaluations = Evaluations(directory, experiment, env, population)
    episodes = EpisodeTable(directory / "episodes.parquet", resumable=True)
    with episodes, ProgressBar.of(experiment) as bar:
        training = train(
            env,
            population.learners,
            experiment.schedule,
            others=population.others,
            decisions=population.decisions,
            callbacks=[evaluations, episodes, bar, *callbacks],
            metrics=experiment.metrics,
            checkpointer=checkpointer,
        )
        save_weights(directory, population.networks())
        save_beside_weights(directory, TRANSFORMS, transforms_state(env))
        if population.decisions is not None:
            save_beside_weights(directory, DECISIONS, population.decisions.learned())
    return training


def _evaluate(
    experiment: Experiment,
    directory: Path,
    env: EnvBase,
    population: Population,
    viewer: "ViewerCallback | None",
    random: list[Episode] | None,
) -> dict[str, pa.Table]:
    """Lets the agents play fresh worlds, writes their episodes, and shows them in the viewer."""
    if viewer is not None:
        viewer.flush()
    played = evaluate_population(experiment, env, population, random=random)
    tables = write_evaluation(directory, played, replicas=experiment.replicas)
    if viewer is not None:
        viewer.finished(played)
    return tables


def _table(env: EnvBase, population: Population, played: Mapping[str, pa.Table]) -> pa.Table:
    """Return the episodes of the evaluation as one table, labelled by "policy": random play, and
    trained, where any agent learns, with the probability with which those with action values explore;
    others draw from a policy."""
    learners = population.learners.values()
    chances = {learner.settings.epsilon_evaluation for learner in learners if not learner.actor.stochastic}
    trained = "trained" + "".join(f", epsilon {chance:g}" for chance in sorted(chances))
    names = {"random": "random", "trained": trained if learners else "agents"}
    table = pa.concat_tables(labelled(played[policy], policy=name) for policy, name in names.items())
    return naming(table, agent_names(env))


@working("drawing the training curve")
def _draw(experiment: Experiment, directory: Path, training: Training, played: pa.Table) -> Path | None:
    if not all(training.episodes_by_replica):
        say(f"No training curve: a replica has ended no episode in {training.steps:,} steps")
        return None
    steps = exploration_steps(experiment.agents)
    ends = None if steps is None else steps / experiment.worlds
    random = where(played, policy="random")
    return training_curve(directory, title=experiment.title, random=random, exploration_turns=ends)


def _write_report(directory: Path, training: Training, times: Times) -> None:
    """Writes `report.json`, the sign that a run is finished."""
    length = training.schedule.length
    episodes = training.episodes_by_replica if length.is_of_steps else length.number
    report: dict[str, Any] = {
        **times.report(training.times),
        "steps": training.steps,
        "finished": datetime.now().astimezone().isoformat(timespec="seconds"),
        "episodes": episodes,
        "worlds": training.schedule.worlds,
        "threads": torch.get_num_threads(),
    }
    if training.finite.reported:
        report["not_finite"] = [asdict(finding) for finding in training.finite.reported]
    write_json(directory / REPORT, report)


def _summarise(
    experiment: Experiment, directory: Path, training: Training, played: pa.Table, figure: Path | None
) -> None:
    """Print the outcome."""
    notes = filter(None, (summary(training.finite.reported), experiment.own_code))
    has_course = all(training.episodes_by_replica) and set(NEEDED) <= set(played.column_names)
    summarise(
        directory,
        title=experiment.title,
        played=played,
        course=course_of(directory, experiment.agents) if has_course else "",
        figure=figure,
        note="\n".join(notes) or None,
    )


def _make_viewer(
    watch: str, directory: Path, experiment: Experiment, env: EnvBase, population: Population
) -> "AbstractContextManager[ViewerCallback | None]":
    if watch == "off":
        return nullcontext()
    from cprl.viewer.callback import ViewerCallback

    live = None if watch == "file" else watch
    exhibition = None if live is None else exhibited(experiment, env, population)
    return ViewerCallback.of(experiment, directory, env, live=live, exhibited=exhibition)


def _say_what_is_kept(experiment: Experiment, directory: Path) -> None:
    for checkpoint in checkpoints_in(directory / FOLDER):
        size = checkpoint.stat().st_size / 1e6
        text = f"Kept to extend it by --resume with more {experiment.length.flag}: {FOLDER}/ending-*.pt"
        console().print(f"{text}, {size:,.0f} MB", style="dim", highlight=False, soft_wrap=True)
