"""run: one experiment from its learners to its report: train, save, evaluate in fresh worlds, summarise."""

from collections.abc import Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

from torchrl.envs import EnvBase

from cprl.agents import Population
from cprl.custom import Custom, made
from cprl.envs.make_env import make_env
from cprl.envs.state import check_restorable, load_transforms_state, transforms_state
from cprl.envs.unwrap import agent_names, commons_of
from cprl.experiment import Experiment
from cprl.measuring.episodes import Episode
from cprl.measuring.evaluate import evaluate
from cprl.process import prepare_process
from cprl.runs.checkpoints import Checkpointer
from cprl.runs.directory import read_recipe, resume_command, start_run, write_json
from cprl.runs.episodes import EpisodeTable
from cprl.runs.loggers import LoggerCallback, check_logger, make_logger
from cprl.runs.weights import save_transforms, save_weights
from cprl.terminal.figures import training_curve
from cprl.terminal.progress import ProgressBar
from cprl.terminal.summary import summarise
from cprl.training import Training, train
from cprl.viewer.callback import ViewerCallback
from cprl.viewer.streams import check_watch


@dataclass(kw_only=True, eq=False)
class _Made:
    """What an experiment makes before anything is written, so that what does not fit is refused first."""

    env: EnvBase
    population: Population
    callbacks: list[Any]


def run(
    experiment: Experiment,
    out: Path | str | None = None,
    *,
    resume: bool = False,
    watch: str = "file",
    allow: Sequence[str] = (),
    command: Sequence[str] | None = None,
) -> Path:
    """Trains the agents of all replicas, evaluates them in fresh worlds, and writes and prints the outcome.

    Args:
        experiment: what is run.
        out: the directory of the run, new or empty; by default `runs/<name>-<time>`.
        resume: whether the run in `out`, which was stopped, is resumed from its newest checkpoint.
        watch: "file" for a recording for the Rerun viewer; "serve", "spawn" or "connect ADDRESS" to watch
            live as well, see `cprl.viewer.streams.open_live`; "off" for none.
        allow: the user's own code, "module:Class", that stored runs of `Frozen` agents may import.
        command: the command line that began the run, script first, which the recipe keeps and the line that
            resumes is made of; by default the run is resumed by `cprl run`.

    Returns:
        The directory, now with `recipe.json`, `episodes.parquet`, `run.rrd`, `checkpoints/final.pt`,
        `evaluation/`, `figures/` and `report.json`.

    Raises:
        ValueError: for whatever does not fit, before anything is written.
        FileExistsError: where `out` is not empty and `resume` is not given.
    """
    check_watch(watch)
    for logger in experiment.loggers:
        check_logger(logger.resolve() if isinstance(logger, Custom) else logger)
    prepare_process(experiment.seed)
    own = _make(experiment, allow)
    directory = start_run(
        None if out is None else Path(out),
        experiment.name,
        experiment.to_recipe,
        resume=resume,
        command=command,
    )
    resuming = resume_command(directory, command)
    training = _train(directory, experiment, own, watch=watch, resuming=resuming)
    played = evaluate_population(experiment, own)
    write_json(
        directory / "report.json",
        {"training_s": round(training.spent_s, 1), "steps": training.steps, "finished": _now()},
    )
    for name, of_policy in played.items():
        _write_episodes(
            directory / "evaluation" / f"{name}.parquet", of_policy, experiment.evaluation_episodes
        )
    title = _title(experiment)
    figure = training_curve(directory, title=title, random=played["random"])
    columns = {"random": played["random"], f"trained{_epsilon(own.population)}": played["trained"]}
    summarise(directory, title=title, played=columns, figure=figure)
    return directory


def _make(experiment: Experiment, allow: Sequence[str]) -> _Made:
    make = partial(
        make_env,
        experiment.game,
        worlds=experiment.replicas,
        seed=experiment.seed,
        device=experiment.device,
        transforms=experiment.transforms,
    )
    env = make()
    if commons_of(env) is None or experiment.transforms:
        check_restorable(make)
    population = Population(
        env, experiment.agents, seed=experiment.seed, engine=experiment.engine, allow=allow
    )
    return _Made(env=env, population=population, callbacks=[made(own) for own in experiment.callbacks])


def _train(directory: Path, experiment: Experiment, own: _Made, *, watch: str, resuming: str) -> Training:
    """Trains and keeps what happens, from the newest checkpoint on if there is one."""
    with ExitStack() as stack:
        viewer = stack.enter_context(_viewer(watch, directory, own.env, experiment))
        checkpointer = Checkpointer(
            directory, resume_command=resuming, log_event=viewer.log_event if viewer else None
        )
        stack.enter_context(checkpointer)
        table = stack.enter_context(EpisodeTable(directory / "episodes.parquet", resumable=True))
        bar = ProgressBar(own.env, episodes=experiment.episodes, replicas=experiment.replicas)
        loggers = [stack.enter_context(_logger(logger, directory, own.env)) for logger in experiment.loggers]
        shown = [viewer] if viewer else []
        training = train(
            own.env,
            own.population.learners,
            others=own.population.others,
            episodes=experiment.episodes,
            callbacks=[table, stack.enter_context(bar), *shown, *loggers, *own.callbacks],
            checkpointer=checkpointer,
            update_every=experiment.update_every,
        )
        save_weights(directory, own.population.networks())
        save_transforms(directory, transforms_state(own.env))
    return training


def _logger(logger: str | Custom, directory: Path, env: EnvBase) -> LoggerCallback:
    return LoggerCallback(
        make_logger(made(logger), directory), replicas=env.batch_size.numel(), agents=agent_names(env)
    )


def evaluate_population(experiment: Experiment, own: _Made) -> dict[str, list[Episode]]:
    """Fresh episodes, so many of each replica: of the "random" policy, and of everybody as "trained"."""
    worlds = experiment.evaluation_episodes
    fresh = make_env(
        experiment.game,
        worlds=experiment.replicas * worlds,
        seed=experiment.seed + 1,
        device=experiment.device,
        transforms=experiment.transforms,
    )
    load_transforms_state(fresh, transforms_state(own.env))
    return {
        "random": evaluate(fresh, own.population.random_policy(worlds)),
        "trained": evaluate(fresh, own.population.policy(worlds), explore=True),
    }


def _epsilon(population: Population) -> str:
    """With which probability learners of values explore in evaluation, for people; others draw from a
    policy."""
    chances = {
        learner.settings.epsilon_evaluation
        for learner in population.learners.values()
        if not learner.actor.stochastic
    }
    return "".join(f", epsilon {chance:g}" for chance in sorted(chances))


def _viewer(
    watch: str, directory: Path, env: EnvBase, experiment: Experiment
) -> AbstractContextManager[ViewerCallback | None]:
    if watch == "off":
        return nullcontext()
    recipe = read_recipe(directory)
    shown = {name: recipe.get(name) for name in ("command", "started", "git", "versions")}
    return ViewerCallback(
        directory,
        env,
        title=_title(experiment),
        episodes=experiment.episodes,
        recipe={**shown, **recipe["experiment"]},
        live=None if watch == "file" else watch,
    )


def _title(experiment: Experiment) -> str:
    """For tables and figures."""
    return f"{experiment.name}, {experiment.replicas} replicas, {experiment.episodes} episodes"


def _write_episodes(path: Path, played: list[Episode], of_replica: int) -> None:
    """Writes episodes in fresh worlds, so many of each replica, as a table; again where one is there."""
    path.parent.mkdir(exist_ok=True)
    path.unlink(missing_ok=True)
    with EpisodeTable(path) as table:
        for number, episode in enumerate(played):
            replica, nth = divmod(number, of_replica)
            table.add(replace(episode, world=replica, episode=nth))


def _now() -> str:
    return datetime.now().astimezone().isoformat(timespec="seconds")
