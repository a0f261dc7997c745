"""One study from its learners to its report: train, keep, evaluate on fresh worlds, summarise."""

from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

from cprl.collectors import StepCollector
from cprl.envs.commons_env import CommonsEnv
from cprl.learners.rollouts import RolloutLearner
from cprl.measuring.episodes import Episode
from cprl.measuring.evaluate import evaluate
from cprl.population import Population
from cprl.runs.checkpoints import Checkpointer
from cprl.runs.directory import read_recipe, write_json
from cprl.runs.episodes import EpisodeTable
from cprl.runs.weights import save_weights
from cprl.terminal.figures import training_curve
from cprl.terminal.progress import ProgressBar
from cprl.terminal.summary import summarise
from cprl.training import MakeCollector, Training, train
from cprl.viewer.callback import ViewerCallback


def conduct(
    run: Path,
    population: Population,
    *,
    episodes: int,
    title: str,
    evaluation_episodes: int = 20,
    update_every: int = 1,
    make_collector: MakeCollector = StepCollector,
    watch: str = "file",
) -> Path:
    """Trains the agents of all replicas, evaluates them on fresh worlds, and writes and prints the outcome.

    A run that was stopped is gone on with from its newest checkpoint.

    Args:
        run: the run's directory, see `cprl.recording.start_run`.
        population: who sits at the seats of every replica.
        episodes: how many each replica trains.
        title: what is run, for tables and figures.
        evaluation_episodes: fresh episodes for each replica, in which learners of values explore with
            `epsilon_evaluation`; and for the random policy at all seats.
        update_every: steps k after which agents learn, then k times.
        make_collector: what plays; see `cprl.training.Training`.
        watch: "file" for a recording to look at in the Rerun viewer; with "serve", "spawn" or "connect
            ADDRESS" live as well, see `cprl.viewer.streams.open_live`; "off" for none.

    Returns:
        The run's directory, now with `episodes.parquet`, `run.rrd`, `checkpoints/final.pt`, `evaluation/`,
        `figures/` and `report.json`, which says how long it took.
    """
    env = CommonsEnv(population.game, population.replicas, seed=population.seed)
    with _watched(watch, run, env, title=title, episodes=episodes) as viewer:
        training = _train(
            run,
            env,
            population,
            viewer,
            episodes=episodes,
            update_every=update_every,
            make_collector=make_collector,
        )
        save_weights(run, population.networks())
    played = evaluate_population(population, worlds=evaluation_episodes)
    write_json(
        run / "report.json",
        {"training_s": round(training.spent_s, 1), "steps": training.steps, "finished": _now()},
    )
    for name, of_policy in played.items():
        _keep(run / "evaluation" / f"{name}.parquet", of_policy, evaluation_episodes)
    figure = training_curve(run, title=title, random=played["random"])
    told = {"random": played["random"], f"trained{_epsilon(population)}": played["trained"]}
    summarise(run, title=title, played=told, figure=figure)
    return run


def _train(
    run: Path,
    env: CommonsEnv,
    population: Population,
    viewer: ViewerCallback | None,
    *,
    episodes: int,
    **how: Any,
) -> Training:
    """Trains and keeps what happens, from the newest checkpoint on if there is one."""
    can_go_on = how["make_collector"] is StepCollector
    with (
        Checkpointer(run, log_event=viewer.log_event if viewer else None) as checkpoints,
        EpisodeTable(run / "episodes.parquet", resumable=True) as table,
        ProgressBar(population.game, episodes=episodes, replicas=population.replicas) as bar,
    ):
        return train(
            env,
            population.learners,
            others=population.others,
            episodes=episodes,
            callbacks=[table, bar, *([viewer] if viewer else [])],
            checkpoints=checkpoints if can_go_on else None,
            **how,
        )


def evaluate_population(population: Population, *, worlds: int) -> dict[str, list[Episode]]:
    """Fresh episodes, so many of each replica: of the "random" policy, and of everybody as "trained"."""
    fresh = CommonsEnv(population.game, population.replicas * worlds, seed=population.seed + 1)
    return {
        "random": evaluate(fresh, population.random_policy(worlds)),
        "trained": evaluate(fresh, population.policy(worlds), explore=True),
    }


def _epsilon(population: Population) -> str:
    """With what chance learners of values explore in evaluation, for people; others draw from a policy."""
    chances = {
        learner.settings.epsilon_evaluation
        for learner in population.learners.values()
        if not isinstance(learner, RolloutLearner) and not learner.actor.stochastic
    }
    return "".join(f", epsilon {chance:g}" for chance in sorted(chances))


def _watched(
    watch: str, run: Path, env: CommonsEnv, *, title: str, episodes: int
) -> AbstractContextManager[ViewerCallback | None]:
    if watch == "off":
        return nullcontext()
    live = None if watch == "file" else watch
    recipe = read_recipe(run)
    told = {name: recipe.get(name) for name in ("command", "started", "git", "versions")}
    return ViewerCallback(
        run, env, title=title, episodes=episodes, recipe={**told, **recipe["arguments"]}, live=live
    )


def _keep(path: Path, played: list[Episode], of_replica: int) -> None:
    """Writes episodes on fresh worlds, so many of each replica, as a table; again where one is there."""
    path.parent.mkdir(exist_ok=True)
    path.unlink(missing_ok=True)
    with EpisodeTable(path) as table:
        for number, episode in enumerate(played):
            replica, nth = divmod(number, of_replica)
            table.add(replace(episode, world=replica, episode=nth))


def _now() -> str:
    return datetime.now().astimezone().isoformat(timespec="seconds")
