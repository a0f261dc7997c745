"""One study from its learners to its report: train, keep, evaluate on fresh worlds, summarise."""

from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from datetime import datetime
from functools import partial
from pathlib import Path

from torch import nn

from cprl.acting.collect import StepCollector
from cprl.acting.lanes import random_seats
from cprl.acting.seats import Seat, Seats
from cprl.envs.torchrl_env import CommonsEnv
from cprl.learning.lanes import LaneLearner
from cprl.measuring.episodes import Episode
from cprl.measuring.evaluate import evaluate
from cprl.recording import (
    Checkpoints,
    EpisodeTable,
    ProgressBar,
    Watch,
    save_weights,
    summarise,
    training_curve,
)
from cprl.recording.run import read_recipe, write_json
from cprl.train import MakeCollector, train


def conduct(
    run: Path,
    agents: LaneLearner,
    *,
    episodes: int,
    title: str,
    random: tuple[int, ...] = (),
    evaluation_episodes: int = 20,
    learn_every: int = 1,
    make_collector: MakeCollector = StepCollector,
    watch: str = "file",
) -> Path:
    """Trains the agents of all replicas, evaluates them on fresh worlds, and writes and prints the outcome.

    A run that was stopped is gone on with from its newest checkpoint.

    Args:
        run: the run's directory, see `cprl.recording.start_run`.
        agents: who learns, at some seats of every replica.
        episodes: how many each replica trains.
        title: what is run, for tables and figures.
        random: the seats to whom every action is equally likely.
        evaluation_episodes: fresh episodes for each replica with `epsilon_evaluation`, and for the random
            policy at all seats.
        learn_every: steps k after which agents learn, then k times.
        make_collector: what plays; see `cprl.train.Training`.
        watch: "file" for a recording to look at in the Rerun viewer; with "serve", "spawn" or "connect
            ADDRESS" live as well, see `cprl.recording.streams.open_live`; "off" for none.

    Returns:
        The run's directory, now with `episodes.parquet`, `run.rrd`, `checkpoints/final.pt`, `evaluation/`,
        `figures/` and `report.json`, which says how long it took.
    """
    game, replicas, seed = agents.game, agents.replicas, agents.seed
    at_random = partial(random_seats, game, replicas=replicas, seed=seed)
    env = CommonsEnv(game, replicas, seed=seed)
    with (
        _watched(watch, run, env, title=title, episodes=episodes) as viewer,
        Checkpoints(run, tell=viewer.tell if viewer else None) as checkpoints,
        EpisodeTable(run / "episodes.parquet", resumable=True) as table,
        ProgressBar(game, episodes=episodes, replicas=replicas) as bar,
    ):
        training = train(
            env,
            {agents.seats: agents},
            others=at_random(random) if random else {},
            episodes=episodes,
            observers=[table, bar, *([viewer] if viewer else [])],
            checkpoints=checkpoints if make_collector is StepCollector else None,
            learn_every=learn_every,
            make_collector=make_collector,
        )
        save_weights(run, agents.networks())

    everyone, worlds = tuple(range(game.agents)), evaluation_episodes
    trained: dict[Seat, nn.Module] = {agents.seats: agents.evaluation_actor(worlds)}
    if random:
        trained |= at_random(random, worlds=worlds)
    fresh = CommonsEnv(game, replicas * worlds, seed=seed + 1)
    played = {
        "random": evaluate(fresh, Seats(at_random(everyone, worlds=worlds))),
        "trained": evaluate(fresh, Seats(trained), explore=True),
    }
    write_json(
        run / "report.json",
        {"training_s": round(training.spent_s, 1), "steps": training.steps, "finished": _now()},
    )
    for name, of_policy in played.items():
        _keep(run / "evaluation" / f"{name}.parquet", of_policy, worlds)
    figure = training_curve(run, title=title, random=played["random"])
    told = {
        "random": played["random"],
        f"trained, epsilon {agents.settings.epsilon_evaluation:g}": played["trained"],
    }
    summarise(run, title=title, played=told, figure=figure)
    return run


def _watched(
    watch: str, run: Path, env: CommonsEnv, *, title: str, episodes: int
) -> AbstractContextManager[Watch | None]:
    if watch == "off":
        return nullcontext()
    live = None if watch == "file" else watch
    recipe = read_recipe(run)
    told = {name: recipe.get(name) for name in ("command", "started", "git", "versions")}
    return Watch(run, env, title=title, episodes=episodes, recipe={**told, **recipe["arguments"]}, live=live)


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
