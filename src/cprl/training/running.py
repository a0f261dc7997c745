"""run: train an experiment, save its agents, evaluate them in fresh worlds, and report."""

import shutil
from collections.abc import Collection, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext, suppress
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import pyarrow as pa
import torch

from cprl.commons.threads import MOST_THREADS
from cprl.envs.env_state import transforms_state
from cprl.envs.unwrap import agent_names
from cprl.experiment import Experiment
from cprl.experiment.engine import about_engine, begun_with, engine_of, planned_updates
from cprl.learners.learner import Learner
from cprl.measuring.table import labelled, store_agent_names, where
from cprl.measuring.tracker import Episode, try_custom_metrics
from cprl.policies.asking import CALLS
from cprl.population import exploration_steps, partners_in
from cprl.runs.checkpoints import CHECKPOINTS, Checkpointer, endings_of
from cprl.runs.episodes import EpisodeTable
from cprl.runs.files import LOCK_FILE, REPORT, RunLockedError, refuse_missing, time_now, write_json
from cprl.runs.length import Length
from cprl.runs.loggers import LoggerCallback, check_logger, make_logger
from cprl.runs.recipe import (
    refuse_another_run,
    warn_of_changes,
    write_circumstances,
    write_metrics,
    write_on_nan,
)
from cprl.runs.states import (
    KEEPS_NO_STATE,
    RunState,
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
    frozen_weights_names,
    save_beside_weights,
    save_weights,
)
from cprl.system.compiling import freed_after_training
from cprl.system.output import RESUME_PREFIX, console, say
from cprl.system.process import prepare_process
from cprl.system.times import Times
from cprl.system.waiting_room import experimental
from cprl.system.working import working
from cprl.terminal.course import NEEDED, course_of
from cprl.terminal.progress import ProgressBar
from cprl.terminal.summary import summarise
from cprl.training.evaluating import (
    Evaluations,
    evaluate_population,
    make_agents,
    make_earlier,
    random_play,
    write_evaluation,
)
from cprl.training.nan_check import findings_note
from cprl.training.training import Training, check_callbacks, train
from cprl.values import Custom, Range, checked, instantiate
from cprl.viewer.page import check_watch

if TYPE_CHECKING:
    from cprl.viewer.callback import ViewerCallback


@freed_after_training()
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

    If the run fails before its training begins, it leaves no files; later, it keeps all files, so that it can
    be resumed. With `resume`, the next step follows from the files in `out` and from the requested length, in
    episodes or steps, see `cprl.runs.states`:

    | files in `out`         | state    | the same length         | a greater length: extend it, then |
    |------------------------|----------|-------------------------|-----------------------------------|
    | recipe.json            | begun    | train from step 0       | train from step 0                 |
    | checkpoints/training-* | stopped  | train from the last one | train from the last one           |
    | report.json            | finished | print that it is        | train from checkpoints/ending-*   |

    Args:
        out: the directory of the run, new or empty; by default `runs/<name>-<time>`.
        resume: whether to resume the stopped run in `out`, or to extend a run of fewer episodes or steps. The
            result equals, bit for bit, that of a run without interruption by the same engine. With
            engine="auto" the engine stays the one with which the run began.
        take_over: whether to resume a run that a process on another host has locked.
        keep_checkpoint: whether a finished run keeps the state of its training, so that it can be extended:
            hundreds of megabytes, buffers included.
        watch: "file" records the run for the Rerun viewer; "serve" and "spawn" also show it live, see
            `cprl.viewer.live.Live`; "off" records nothing.
        linger: whether to serve the recording after the run, until Ctrl-C (SIGINT) or SIGTERM; only with
            `watch` "serve" or "spawn".
        threads: the number of torch's threads. Several are faster for large minibatches of many worlds, if no
            other program needs the cores; results then differ in their last bits.
        callbacks: more callbacks, see `cprl.training.Callback`. The recipe does not hold them, so they may
            observe the training but not change it.
        figures: whether the training curve is drawn; a study draws its own.

    Returns:
        The directory, now with `recipe.json`, `episodes.parquet`, `run.rrd`, `checkpoints/final.pt`,
        `evaluation/`, `figures/`, `manifest.json` with their checksums, and `report.json`.

    Raises:
        RunLockedError: if another process writes the run.
        KeyboardInterrupt: after the first SIGINT (Ctrl-C), once the state is saved and the command that
            resumes the run is printed. A second SIGINT ends the process at once.
        SystemExit: with code 143 after SIGTERM, in the same way.
        FileExistsError: if `out` is not empty and `resume` is False.
        OSError: for a full disk or a deleted directory, which the message names. Earlier files are intact,
            and the run can be resumed.
    """
    times = Times()
    _prepare(experiment, watch, linger=linger, threads=threads)
    opened = _OpenRun(experiment, out, resume=resume, callbacks=callbacks)
    directory = opened.directory
    if opened.step == "already_finished" and not (directory / LOCK_FILE).exists():
        return _say_finished(directory, opened.experiment)
    checkpointer = Checkpointer(directory, keep_ending=keep_checkpoint, take_over=take_over)
    with ExitStack() as viewer_stack:  # the viewer stays open after the checkpointer has unlocked the run
        with _cleaned_up(checkpointer, viewer_stack, opened), checkpointer:
            if not _begin(opened):
                checkpointer.done()
                return directory
            opened.population.calls.keep_in(directory / CALLS)
            viewer = viewer_stack.enter_context(_make_viewer(watch, opened))
            random_episodes = _play_at_random(opened, viewer)
            training = _train(opened, viewer, checkpointer)
            evaluation = _evaluate(opened, viewer, random_episodes)
            figure = _draw_curve(opened, training, evaluation) if figures else None
            _write_report(directory, training, times)
            _summarise(opened, training, evaluation, figure)
            checkpointer.done()
            _say_kept_state(opened)
        for observer in opened.observers:
            if hasattr(observer, "on_finished"):
                observer.on_finished(directory)
        if linger and viewer is not None:
            viewer.linger()
    return directory


class _OpenRun:
    """A run whose directory, worlds and agents exist, before its training begins.

    Opening it refuses what would fail later, and makes the directory of a new run last.
    """

    def __init__(
        self, requested: Experiment, out: Path | str | None, *, resume: bool, callbacks: Sequence[object]
    ) -> None:
        out = None if out is None else Path(out)
        resumed = out if resume else None
        self.requested = requested
        """The experiment of the caller, whose engine may be "auto"."""
        self.experiment = _with_engine(requested, resumed)
        """The experiment with the engine that trains it."""
        self.resume = resume
        """True for a run that is resumed or extended, False for a new one."""
        self.is_new = out is None or not out.exists()
        """True if the directory did not exist before."""
        state, _, self.step = _find_next_step(out, self.experiment, resume=resume)
        with working("making agents"):
            partners = partners_in(self.experiment.specs)
            weights = {} if resumed is None else frozen_weights_names(resumed, partners)
            starts = state in ("missing", "begun")
            self.env, self.population = make_agents(self.experiment, starts=starts, weights=weights)
            self.earlier = make_earlier(self.experiment, self.env, self.population)
            """The worlds of earlier games, see `Experiment.earlier`."""
        self.observers: list[Any] = [*map(instantiate, self.experiment.callbacks), *callbacks]
        """The callbacks of the experiment and of the caller."""
        check_callbacks(self.observers)
        self.metric_words = try_custom_metrics(self.experiment.metrics, self.env)
        """The "title" and "unit" of custom metrics."""
        self.directory = start(out, self.experiment, partners) if resumed is None else resumed


def _begin(run: _OpenRun) -> bool:
    """Prepare the locked directory for the training; return False if the run turns out to be finished.

    The state of the directory is read again, because another process may have finished or extended the run
    before this one locked it.
    """
    state, length, step = _find_next_step(run.directory, run.experiment, resume=run.resume)
    if step == "already_finished":
        _say_finished(run.directory, run.experiment)
        return False
    if step == "extend":
        refuse_to_extend(run.directory, length, run.observers)
    if step != "start":
        _prepare_to_resume(run.directory, run.experiment, state, length)
    _say_engine(run.requested, run.experiment, state)
    write_metrics(run.directory, run.metric_words)
    return True


def _with_engine(experiment: Experiment, resumed: Path | None) -> Experiment:
    """Return the experiment with the engine that trains it in place of "auto".

    A resumed run keeps the engine with which it began, so that its numbers equal those of an uninterrupted
    run.
    """
    if experiment.engine != "auto":
        return experiment
    begun = None if resumed is None else begun_with(resumed)
    return replace(experiment, engine=begun or engine_of(experiment))


def _say_engine(requested: Experiment, experiment: Experiment, state: RunState) -> None:
    """Print which engine "auto" stands for, when a training begins, or resumes with another than it would
    choose now."""
    if requested.engine != "auto":
        return
    if experiment.engine != engine_of(requested):
        say(f'Trains with engine="{experiment.engine}", as the run began.')
    elif state in ("missing", "begun") and planned_updates(requested):
        say(about_engine(requested))


def _find_next_step(
    out: Path | None, experiment: Experiment, *, resume: bool
) -> tuple[RunState, Length, Step]:
    """Return the state of a run's directory, the run's length so far, and the next step."""
    if not resume:
        return "missing", experiment.length, "start"
    length = refuse_another_run(out, experiment.to_recipe, Experiment)
    state = state_of(out)
    return state, length, next_step(state, length, experiment.length)


def _prepare(experiment: Experiment, watch: str, *, linger: bool, threads: int) -> None:
    """Check the viewer and the loggers, and prepare the process."""
    check_watch(watch, linger=linger)
    for logger in experiment.loggers:
        if isinstance(logger, Custom):
            logger.resolve()
        else:
            check_logger(logger)
    threads = checked("threads", threads, Annotated[int, Range(1, MOST_THREADS)])
    prepare_process(experiment.seed, threads=threads)


def _prepare_to_resume(run: Path, experiment: Experiment, state: RunState, length: Length) -> None:
    """Print what has changed since a run was begun, record it in the recipe, and extend the run if it shall
    be longer."""
    warn_of_changes(run, write_circumstances(run))
    if state == "begun":
        say("No checkpoint yet: begins with the first episode")
    write_on_nan(run, experiment.on_nan)
    if length.is_shorter_than(experiment.length):
        extend(run, length, experiment.length)


def _say_finished(run: Path, experiment: Experiment) -> Path:
    """Print that a run is finished; refuse one that has lost files."""
    refuse_missing(run)
    more = f"with more {experiment.length.flag} it is extended" if endings_of(run) else KEEPS_NO_STATE
    console().print(f"{run} is finished; {more}", soft_wrap=True)
    return run


@contextmanager
def _cleaned_up(checkpointer: Checkpointer, viewer_stack: ExitStack, run: _OpenRun) -> Iterator[None]:
    """Clean up if the block raises an error, after its viewer is closed.

    If the training has begun, all files stay, and the error says how to resume. If a new run fails before
    its training begins, its files are removed, and its directory too if it did not exist before.
    """
    resumes = f"{RESUME_PREFIX}{checkpointer.resume_command}"
    is_new_run = run.step == "start"
    try:
        yield
    except BaseException as error:
        viewer_stack.close()
        is_stopped = isinstance(error, KeyboardInterrupt | SystemExit)
        if checkpointer.has_begun or (not is_new_run and isinstance(error, OSError)):
            error.add_note(resumes)
        elif not is_new_run and is_stopped:
            say(resumes)
        elif is_new_run and not isinstance(error, RunLockedError):
            _remove_files(checkpointer.run, with_directory=run.is_new)
            if is_stopped:
                say("Stopped before the training began: nothing was written.")
        raise


def _remove_files(directory: Path, *, with_directory: bool) -> None:
    """Remove the content of a directory, as far as that is possible, and the directory too if asked to."""
    with suppress(OSError):
        for path in directory.iterdir():
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()
        if with_directory:
            directory.rmdir()


@contextmanager
def _loggers(experiment: Experiment, directory: Path, *, resumes: bool) -> Iterator[list[LoggerCallback]]:
    """Keep the experiment's loggers open within the block."""
    with ExitStack() as stack:
        loggers = [make_logger(instantiate(logger), directory) for logger in experiment.loggers]
        yield [stack.enter_context(LoggerCallback(logger, resumes=resumes)) for logger in loggers]


def _play_at_random(run: _OpenRun, viewer: "ViewerCallback | None") -> list[Episode] | None:
    """Play at random, for comparison with the training, and show it in the viewer.

    Returns:
        The episodes; None without a viewer, since nobody would see them during the training.
    """
    if viewer is None:
        return None
    episodes = random_play(run.experiment, run.population, seen=viewer.seen_at_random)
    viewer.random_play(episodes)
    return episodes


def _train(run: _OpenRun, viewer: "ViewerCallback | None", checkpointer: Checkpointer) -> Training:
    """Train, and save what the agents have learned."""
    viewers = [] if viewer is None else [viewer]
    evaluations = Evaluations(run.directory, run.experiment, run.population)
    with _loggers(run.experiment, run.directory, resumes=run.resume) as loggers:
        table = EpisodeTable(run.directory / "episodes.parquet", resumable=True)
        with table, ProgressBar.of(run.experiment, run.population.calls.in_words) as progress_bar:
            training = train(
                run.env,
                run.population.learners,
                run.experiment.schedule,
                others=run.population.others,
                decisions=run.population.decisions,
                governor=run.population.governor,
                callbacks=[evaluations, table, progress_bar, *run.observers, *viewers, *loggers],
                metrics=run.experiment.metrics,
                earlier=run.earlier,
                checkpointer=checkpointer,
            )
            _save_learned(run)
    return training


def _save_learned(run: _OpenRun) -> None:
    """Save the weights of the agents' networks, and the states of transforms and decisions."""
    save_weights(run.directory, run.population.networks())
    save_beside_weights(run.directory, TRANSFORMS, transforms_state(run.env))
    if run.population.decisions is not None:
        save_beside_weights(run.directory, DECISIONS, run.population.decisions.learned())


def _evaluate(
    run: _OpenRun, viewer: "ViewerCallback | None", random_episodes: list[Episode] | None
) -> pa.Table:
    """Let the agents play fresh worlds, write their episodes, and show them in the viewer.

    Args:
        random_episodes: the episodes of `_play_at_random`.

    Returns:
        The episodes of random play and of the trained agents, labelled by "policy".
    """
    if viewer is not None:
        viewer.flush()
    episodes = evaluate_population(run.experiment, run.env, run.population, random=random_episodes)
    tables = write_evaluation(run.directory, episodes, replicas=run.experiment.replicas)
    if viewer is not None:
        viewer.finished(episodes)
    trained = _trained_label(run.population.learners.values())
    random_table = labelled(tables["random"], policy="random")
    trained_table = labelled(tables["trained"], policy=trained)
    return store_agent_names(pa.concat_tables([random_table, trained_table]), agent_names(run.env))


@working("drawing the training curve")
def _draw_curve(run: _OpenRun, training: Training, evaluation: pa.Table) -> Path | None:
    """Draw the training curve, and return its file; None if a replica has ended no episode."""
    from cprl.terminal.figures import training_curve  # takes half a second, for which no training waits

    if not all(training.episodes_by_replica):
        say(f"No training curve: a replica has ended no episode in {training.steps:,} steps")
        return None
    steps = exploration_steps(run.experiment.agents)
    return training_curve(
        run.directory,
        title=run.experiment.title,
        random=where(evaluation, policy="random"),
        exploration_turns=None if steps is None else steps / run.experiment.worlds,
    )


def _summarise(run: _OpenRun, training: Training, evaluation: pa.Table, figure: Path | None) -> None:
    """Print the summary of the run."""
    experiment = run.experiment
    calls = run.population.calls.in_words()
    notes = filter(None, (findings_note(training.finite.reported), experiment.custom_code, calls))
    course = ""
    if all(training.episodes_by_replica) and set(NEEDED) <= set(evaluation.column_names):
        course = course_of(run.directory, experiment.agents)
    summarise(
        run.directory,
        title=experiment.title,
        played=evaluation,
        course=course,
        figure=figure,
        note="\n".join(notes) or None,
    )


def _trained_label(learners: Collection[Learner]) -> str:
    """Return the label of trained agents in tables, with the epsilons of those that explore by one.

    Examples: "trained", "trained, epsilon 0.05", "agents" if no agent learns.
    """
    if not learners:
        return "agents"
    epsilons = {learner.settings.epsilon_evaluation for learner in learners if not learner.actor.stochastic}
    return "".join(["trained", *(f", epsilon {epsilon:g}" for epsilon in sorted(epsilons))])


def _write_report(directory: Path, training: Training, times: Times) -> None:
    """Write `report.json`, which marks the run as finished."""
    length = training.schedule.length
    episodes = training.episodes_by_replica if length.is_of_steps else length.number
    report: dict[str, Any] = {
        **times.report(training.times),
        "steps": training.steps,
        "finished": time_now(),
        "episodes": episodes,
        "worlds": training.schedule.worlds,
        "threads": torch.get_num_threads(),
    }
    if training.finite.reported:
        report["not_finite"] = [asdict(finding) for finding in training.finite.reported]
    write_json(directory / REPORT, report)


def _make_viewer(watch: str, run: _OpenRun) -> "AbstractContextManager[ViewerCallback | None]":
    """Return the callback that records the run for the viewer; a context manager of None for "off"."""
    if watch == "off":
        return nullcontext()
    from cprl.viewer.callback import ViewerCallback

    live = None if watch == "file" else watch
    exhibit = None
    if live is not None:
        exhibit = partial(experimental("exhibition.exhibition"), run.experiment, run.population)
    return ViewerCallback.of(run.experiment, run.directory, run.env, live=live, exhibit=exhibit)


def _say_kept_state(run: _OpenRun) -> None:
    """Print how to extend the run, if it keeps the state of its training."""
    for ending in endings_of(run.directory):
        size_mb = ending.stat().st_size / 1e6
        text = (
            f"Kept to extend it by --resume with more {run.experiment.length.flag}: {CHECKPOINTS}/ending-*.pt"
        )
        console().print(f"{text}, {size_mb:,.0f} MB", style="dim", highlight=False, soft_wrap=True)
