"""The parts of an experiment: what is made of it before anything is written, and what logs its training."""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torchrl.envs import EnvBase

from cprl.custom import Custom, made
from cprl.envs.make_env import make_env
from cprl.envs.unwrap import agent_names
from cprl.experiment import Experiment
from cprl.runs.directory import read_recipe
from cprl.runs.loggers import LoggerCallback, make_logger
from cprl.training.agents import Population
from cprl.training.outcome import exhibited, fresh_env
from cprl.viewer.callback import ViewerCallback


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
        allow: see `cprl.run`.
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


def make_logger_callback(logger: str | Custom, directory: Path, env: EnvBase) -> LoggerCallback:
    return LoggerCallback(
        make_logger(made(logger), directory), replicas=env.batch_size.numel(), agents=agent_names(env)
    )


def make_viewer(
    watch: str, directory: Path, own: Parts, experiment: Experiment
) -> AbstractContextManager[ViewerCallback | None]:
    if watch == "off":
        return nullcontext()
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
