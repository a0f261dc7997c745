"""run: one experiment from its learners to its report: train, save, evaluate in fresh worlds, summarise."""

import shutil
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cprl.checks import shown
from cprl.custom import Custom, made
from cprl.envs.state import transforms_state
from cprl.envs.unwrap import agent_names
from cprl.experiment import Experiment
from cprl.measuring.episodes import Episode
from cprl.population import Frozen, exploration_steps
from cprl.runs.checkpoints import FOLDER, REPORT, Checkpointer, checkpoints_in, extend, refuse_to_extend
from cprl.runs.episodes import EpisodeTable
from cprl.runs.files import LOCK_FILE, RunLockedError, refuse_missing, write_json
from cprl.runs.loggers import LoggerCallback, check_logger, make_logger
from cprl.runs.recipe import (
    RECIPE_FILE,
    changed_circumstances,
    read_recipe,
    refuse_another_run,
    resume_command,
    say_changes,
    start_run,
    write_changed_circumstances,
    write_on_nan,
)
from cprl.runs.weights import partners_of, save_decisions, save_transforms, save_weights, weights_of
from cprl.system.compile_clock import cleared_up, free_earlier
from cprl.system.output import RESUMES, console, say
from cprl.system.process import prepare_process
from cprl.system.times import RunTimes
from cprl.terminal.figures import training_curve
from cprl.terminal.progress import ProgressBar
from cprl.terminal.summary import summarise
from cprl.training import Training, train
from cprl.training.finite import summary
from cprl.training.outcome import (
    Parts,
    evaluate_population,
    heading,
    make_parts,
    make_viewer,
    random_play,
    title_of,
    write_evaluation,
)
from cprl.training.training import check_callbacks
from cprl.viewer.watching import check_linger, check_watch
from cprl.viewer.watching import linger as stay_served

if TYPE_CHECKING:
    from cprl.viewer.callback import ViewerCallback


class _Began:
    """A callback that notes that the training has begun."""

    is_extendable = True
    has_begun = False

    def on_start(self, training: Training) -> None:
        self.has_begun = True


@cleared_up()
def run(
    experiment: Experiment,
    out: Path | str | None = None,
    *,
    resume: bool = False,
    take_over: bool = False,
    keep_checkpoint: bool = True,
    watch: str = "file",
    linger: bool = False,
    allow: Sequence[str] = (),
    command: Sequence[str] | None = None,
    callbacks: Sequence[object] = (),
    figures: bool = True,
    at_end: Callable[[Path], object] | None = None,
) -> Path:
    """Trains the agents of all replicas, evaluates them in fresh worlds, and writes and prints the outcome.

    A run that ends before its training has begun leaves nothing behind; later, all that it produced.

    Args:
        out: the directory of the run, new or empty; by default `runs/<name>-<time>`.
        resume: whether the run in `out`, which was stopped, is resumed from its newest checkpoint, or a run
            of fewer episodes, stopped or finished, is extended. Either equals a run that was not interrupted,
            bit for bit. Of a finished run of as many episodes nothing is done.
        take_over: whether to resume a run that a process on another host has locked.
        keep_checkpoint: whether a finished run keeps the state of its training, buffers included, so that it
            can be extended.
        watch: "file" for a recording for the Rerun viewer; "serve" or "spawn" to watch
            live as well, see `cprl.viewer.streams.open_live`; "off" for none.
        linger: whether the recording stays served after the run, until Ctrl-C (SIGINT) or SIGTERM; only with
            `watch` "serve" or "spawn".
        allow: the user's own code, "module:Class", that stored runs of `Frozen` agents may import.
        command: the command line that began the run, script first, which the recipe keeps and the line that
            resumes is made of; by default the run is resumed by `cprl run`.
        callbacks: further callbacks of this process (see `cprl.training.training`), which the recipe does
            not hold; they may look, and change nothing.
        figures: whether the training curve is drawn; a study draws its own.
        at_end: called with the directory of a run that has just finished, when all is written and said.

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

    def recipe_in(directory: Path) -> dict[str, Any]:
        return {**experiment.to_recipe(directory), **partners_of(directory, _partners(experiment))}

    times = RunTimes()
    free_earlier()
    out = None if out is None else Path(out)
    check_watch(watch)
    check_linger(linger, watch)
    if at_end is not None and not callable(at_end):  # found out after hours otherwise
        raise ValueError(f"at_end is {shown(at_end)}; allowed: a function")
    for logger in experiment.loggers:
        check_logger(logger.resolve() if isinstance(logger, Custom) else logger)
    prepare_process(experiment.seed)
    is_begun = resume and out is not None and bool(checkpoints_in(out / FOLDER))
    weights = _partners_then(experiment, out) if resume and out is not None else {}
    own = make_parts(experiment, allow, starts=not is_begun, weights=weights)
    own.callbacks += check_callbacks(callbacks)
    episodes = refuse_another_run(out, experiment.to_recipe, Experiment) if resume else experiment.episodes
    is_there = out is not None and out.exists()
    if resume and out is not None:
        if episodes < experiment.episodes:
            refuse_to_extend(out, episodes, own.callbacks)
        elif (out / REPORT).exists():
            tidy_up(out, keep_checkpoint=keep_checkpoint, take_over=take_over)
            return out
        directory = out
    else:
        directory = start_run(out, experiment.name, recipe_in, command=command)
    checkpointer = Checkpointer(
        directory,
        keep_ending=keep_checkpoint,
        take_over=take_over,
        resume_command=resume_command(directory, command),
    )
    began = _Began()
    closing = ExitStack()  # of the viewer, which outlives the rest
    try:
        with checkpointer:
            if resume:
                say_what_changed(directory)
                if not is_begun:
                    say("No checkpoint yet: begins with the first episode")
                write_on_nan(directory, experiment.on_nan)
            if episodes < experiment.episodes:
                extend(directory, episodes, experiment.episodes)
            viewer = closing.enter_context(make_viewer(watch, directory, own, experiment))
            _train_and_evaluate(directory, experiment, own, viewer, checkpointer, began, times, figures)
            checkpointer.done()
            say_what_is_kept(directory)
    except BaseException as error:
        closing.close()
        if began.has_begun or (resume and isinstance(error, OSError)):
            error.add_note(f"{RESUMES}{checkpointer.resume_command}")
        elif not resume and not isinstance(error, RunLockedError):
            remove(directory, but_keep_empty=is_there)
        raise
    with closing:
        if at_end is not None:
            at_end(directory)
        if linger and viewer is not None:
            stay_served(viewer.logger, viewer.play_on)
    return directory


def _partners(experiment: Experiment) -> list[str]:
    """The runs whose agents play."""
    return sorted({spec.run for spec in experiment.agents if isinstance(spec, Frozen)})


def _partners_then(experiment: Experiment, run: Path) -> dict[str, str]:
    """The names of the weights of `Frozen` agents that played when a run began, by their run."""
    partners = _partners(experiment)
    recipe = read_recipe(run) if partners and (run / RECIPE_FILE).exists() else {}
    names = {partner: weights_of(recipe, run, partner) for partner in partners}
    return {partner: name for partner, name in names.items() if name is not None}


def _train_and_evaluate(
    directory: Path,
    experiment: Experiment,
    own: Parts,
    viewer: "ViewerCallback | None",
    checkpointer: Checkpointer,
    began: _Began,
    times: RunTimes,
    figures: bool,
) -> None:
    """All that follows the beginning; `report.json`, the sign that a run is finished, comes last."""
    training, before = _train(
        directory, experiment, own, viewer=viewer, checkpointer=checkpointer, began=began
    )
    played = evaluate_population(experiment, own.env, own.population, random=before)
    write_evaluation(directory, played, of_replica=experiment.evaluation_episodes)
    if viewer is not None:
        viewer.finished(played)
    title, figure = title_of(experiment), None
    if figures:
        ends = exploration_steps(experiment.agents)
        figure = training_curve(directory, title=title, random=played["random"], exploration_steps=ends)
    broken = training.finite.found
    report = {
        **times.report(training.times),
        "steps": training.steps,
        "finished": datetime.now().astimezone().isoformat(timespec="seconds"),
    }
    also = {"not_finite": [asdict(one) for one in broken]} if broken else {}
    write_json(directory / REPORT, {**report, "episodes": experiment.episodes, **also})
    columns = {"random": played["random"], heading(own.population): played["trained"]}
    summarise(directory, title=title, played=columns, figure=figure, note=summary(broken))


def _train(
    directory: Path,
    experiment: Experiment,
    own: Parts,
    *,
    viewer: "ViewerCallback | None",
    checkpointer: Checkpointer,
    began: _Began,
) -> tuple[Training, list[Episode] | None]:
    """Trains and keeps what happens, from the newest checkpoint on if there is one.

    Returns:
        The training, and what the viewer compares it with: random play, None without a viewer.
    """
    with ExitStack() as stack:
        table = stack.enter_context(EpisodeTable(directory / "episodes.parquet", resumable=True))
        bar = stack.enter_context(
            ProgressBar(own.env, episodes=experiment.episodes, replicas=experiment.replicas)
        )
        loggers = [
            stack.enter_context(
                LoggerCallback(
                    make_logger(made(logger), directory),
                    replicas=experiment.replicas,
                    agents=agent_names(own.env),
                )
            )
            for logger in experiment.loggers
        ]
        before = None
        if viewer is not None:
            before = random_play(experiment, own.population)
            viewer.random_play(before)
        shown = [viewer] if viewer else []
        training = train(
            own.env,
            own.population.learners,
            others=own.population.others,
            decisions=own.population.decisions,
            episodes=experiment.episodes,
            callbacks=[began, table, bar, *own.callbacks, *shown, *loggers],
            checkpointer=checkpointer,
            update_every=experiment.update_every,
            on_nan=experiment.on_nan,
        )
        save_weights(directory, own.population.networks())
        save_transforms(directory, transforms_state(own.env))
        if own.population.decisions is not None:
            save_decisions(directory, own.population.decisions.learned())
    if viewer is not None:
        viewer.flush()
    return training, before


def tidy_up(finished: Path, *, keep_checkpoint: bool, take_over: bool) -> None:
    """Says that a run is finished, and tidies up if its process died before it had."""
    refuse_missing(finished)
    if (finished / LOCK_FILE).exists():
        with Checkpointer(finished, keep_ending=keep_checkpoint, take_over=take_over) as left:
            left.done()
    console().print(f"{finished} is finished; with more --episodes it is extended", soft_wrap=True)


def remove(directory: Path, *, but_keep_empty: bool) -> None:
    """Removes a run that never began; nobody else has written into its directory."""
    with suppress(OSError):
        for path in directory.iterdir():
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()
        if not but_keep_empty:
            directory.rmdir()


def say_what_is_kept(directory: Path) -> None:
    """Says what of a finished run serves to extend it, and how large it is."""
    for kept in checkpoints_in(directory / FOLDER):
        console().print(
            f"Kept so that it can be extended (--resume with more --episodes): {kept}, "
            f"{kept.stat().st_size / 1e6:,.1f} MB",
            soft_wrap=True,
        )


def say_what_changed(directory: Path) -> None:
    """Warns where a run that goes on was begun under other versions or other code, and writes that down."""
    changed = changed_circumstances(directory)
    say_changes(directory, changed)
    if changed:
        write_changed_circumstances(directory)
