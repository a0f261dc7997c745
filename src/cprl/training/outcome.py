"""The outcome of a training: its agents in fresh worlds, beside the random policy."""

import random as random_of_python
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import torch
from torchrl.envs import EnvBase

from cprl.custom import made
from cprl.envs.make_env import OF_CPRL, make_env
from cprl.envs.state import load_transforms_state, transforms_state
from cprl.envs.unwrap import commons_of
from cprl.experiment import Experiment
from cprl.measuring.episodes import Episode
from cprl.measuring.evaluate import evaluate
from cprl.policies.present import PresentPolicy
from cprl.runs.episodes import EpisodeTable
from cprl.runs.recipe import read_recipe
from cprl.training.agents import Population

if TYPE_CHECKING:
    from cprl.viewer.callback import ViewerCallback

EXHIBITED_WORLD: Final = 2**31
"""The number of the exhibited world; those of a training, of as many replicas, are smaller."""


def fresh_env(experiment: Experiment) -> EnvBase:
    """The worlds of the evaluation, `evaluation_episodes` for each replica, which no training plays."""
    return make_env(
        experiment.game,
        worlds=experiment.replicas * experiment.evaluation_episodes,
        seed=experiment.seed + 1,
        device=experiment.device,
        transforms=experiment.transforms,
    )


def exhibited(
    experiment: Experiment, trained: EnvBase, population: Population
) -> tuple[PresentPolicy, EnvBase] | None:
    """The present policy, and one world for it that neither training nor evaluation plays; None where the
    game has no board. Torch's generator is left as it was."""
    if commons_of(trained) is None:
        return None
    with torch.random.fork_rng(devices=[]):
        env = make_env(
            experiment.game,
            seed=experiment.seed,
            first_world=EXHIBITED_WORLD,
            device=experiment.device,
            transforms=experiment.transforms,
        )
        return population.present_policy(), env


def random_play(experiment: Experiment, population: Population) -> list[Episode]:
    """Lets agents who take every action with equal probability play the worlds of the evaluation, before the
    training: what it is compared with while it runs, `evaluation_episodes` for each replica. No generator
    moves."""
    with _generators_kept(experiment.device):
        return evaluate(fresh_env(experiment), population.random_policy(experiment.evaluation_episodes))


@contextmanager
def _generators_kept(device: str) -> Iterator[None]:
    """Puts the global generators back where they were: games of somebody else's may draw from them."""
    of_python = random_of_python.getstate()
    of_numpy = np.random.get_state()  # noqa: NPY002  (the global generator is the point)
    gpus = [torch.device(device)] if torch.device(device).type == "cuda" else []
    try:
        with torch.random.fork_rng(devices=gpus):
            yield
    finally:
        random_of_python.setstate(of_python)
        np.random.set_state(of_numpy)  # noqa: NPY002


def is_same_later(experiment: Experiment) -> bool:
    """Whether random play is the same before and after a training: the game is one of cprl's, whose chance
    depends on seeds alone, and has no transforms, which may learn in between."""
    return isinstance(experiment.game, OF_CPRL) and not experiment.transforms


def _keeps_decisions(env: EnvBase) -> bool:
    """Whether what agents decided stays in force for several episodes."""
    commons = commons_of(env)
    return commons is not None and any(ballot.period_episodes > 1 for ballot in commons.game.ballots)


def evaluate_population(
    experiment: Experiment, trained: EnvBase, population: Population, *, random: list[Episode] | None = None
) -> dict[str, list[Episode]]:
    """Lets the agents play fresh episodes, so many of each replica.

    Args:
        experiment: what was trained.
        trained: the environment of the training; what its transforms have learned is used.
        random: the episodes of `random_play`, which are not played again if they are the same now.

    Returns:
        The episodes by policy: "random", and "trained", everybody as they are now.
    """
    fresh, worlds = fresh_env(experiment), experiment.evaluation_episodes
    load_transforms_state(fresh, transforms_state(trained))
    if random is None or not is_same_later(experiment):
        random = evaluate(fresh, population.random_policy(worlds))
    elif not _keeps_decisions(trained):
        fresh.reset()  # the trained agents play the second episode of each world
    if _keeps_decisions(trained):
        fresh = fresh_env(experiment)  # or its first one, where what others decided would stay in force
    load_transforms_state(fresh, transforms_state(trained))  # which random play may have changed
    return {"random": random, "trained": evaluate(fresh, population.policy(worlds), explore=True)}


def write_evaluation(run: Path, played: Mapping[str, Sequence[Episode]], *, of_replica: int) -> None:
    """Writes `evaluation/<policy>.parquet` of a run; again where one is there.

    Args:
        played: the episodes by policy.
        of_replica: how many of them each replica has.
    """
    for name, episodes in played.items():
        path = run / "evaluation" / f"{name}.parquet"
        path.parent.mkdir(exist_ok=True)
        for old in (path, path.with_suffix(".arrows")):
            old.unlink(missing_ok=True)
        with EpisodeTable(path, run=run) as table:
            for number, episode in enumerate(episodes):
                replica, nth = divmod(number, of_replica)
                table.add(replace(episode, world=replica, episode=nth))


def heading(population: Population) -> str:
    """What a table of the evaluation calls the agents: trained, where any learns, and with which probability
    those with action values explore; others draw from a policy."""
    if not population.learners:
        return "agents"
    chances = {
        learner.settings.epsilon_evaluation
        for learner in population.learners.values()
        if not learner.actor.stochastic
    }
    return "trained" + "".join(f", epsilon {chance:g}" for chance in sorted(chances))


@dataclass(kw_only=True, eq=False)
class Parts:
    """What an experiment makes before anything is written, so that what does not fit is refused first."""

    env: EnvBase
    population: Population
    callbacks: list[Any]


def make_parts(
    experiment: Experiment,
    allow: Sequence[str],
    *,
    starts: bool = True,
    weights: Mapping[str, str] | None = None,
) -> Parts:
    """The parts; raises a ValueError for whatever does not fit.

    Args:
        experiment: what they are made of.
        starts: whether agents start with the weights of stored ones, where they ask for it; a training that
            is resumed reads its own.
        weights: those that `Frozen` agents play with, see `Population`.
    """
    env = make_env(
        experiment.game,
        worlds=experiment.replicas,
        seed=experiment.seed,
        device=experiment.device,
        transforms=experiment.transforms,
    )
    population = Population(
        env,
        experiment.agents,
        seed=experiment.seed,
        engine=experiment.engine,
        allow=allow,
        starts=starts,
        weights=weights,
    )
    with torch.random.fork_rng(devices=[]):
        fresh_env(experiment)  # what the evaluation cannot have is refused now, not after hours
        population.random_policy(experiment.evaluation_episodes)
        population.policy(experiment.evaluation_episodes)
    return Parts(env=env, population=population, callbacks=[made(own) for own in experiment.callbacks])


def make_viewer(
    watch: str, directory: Path, own: Parts, experiment: Experiment
) -> "AbstractContextManager[ViewerCallback | None]":
    if watch == "off":
        return nullcontext()
    from cprl.viewer.callback import ViewerCallback

    recipe = read_recipe(directory)
    shown = {name: recipe.get(name) for name in ("command", "started", "git", "versions")}
    return ViewerCallback(
        directory,
        own.env,
        title=title_of(experiment),
        episodes=experiment.episodes,
        recipe={**shown, **recipe["experiment"]},
        live=None if watch == "file" else watch,
        exhibited=None if watch == "file" else exhibited(experiment, own.env, own.population),
    )


def title_of(experiment: Experiment) -> str:
    """For tables and figures."""
    return f"{experiment.name}, {experiment.replicas} replicas, {experiment.episodes} episodes"
