"""The outcome of a training: its agents in fresh worlds, beside the random policy."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import torch
from torchrl.envs import EnvBase

from cprl.agents import Population
from cprl.envs.make_env import make_env
from cprl.envs.state import load_transforms_state, transforms_state
from cprl.envs.unwrap import commons_of
from cprl.experiment import Experiment
from cprl.measuring.episodes import Episode
from cprl.measuring.evaluate import evaluate
from cprl.policies.present import PresentPolicy
from cprl.runs.episodes import EpisodeTable

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


def evaluate_population(
    experiment: Experiment, trained: EnvBase, population: Population
) -> dict[str, list[Episode]]:
    """Lets the agents play fresh episodes, so many of each replica.

    Args:
        experiment: what was trained.
        trained: the environment of the training; what its transforms have learned is used.
        population: the agents.

    Returns:
        The episodes by policy: "random", and "trained", everybody as they are now.
    """
    fresh, worlds = fresh_env(experiment), experiment.evaluation_episodes
    load_transforms_state(fresh, transforms_state(trained))
    return {
        "random": evaluate(fresh, population.random_policy(worlds)),
        "trained": evaluate(fresh, population.policy(worlds), explore=True),
    }


def write_evaluation(run: Path, played: Mapping[str, Sequence[Episode]], *, of_replica: int) -> None:
    """Writes `evaluation/<policy>.parquet` of a run; again where one is there.

    Args:
        run: the run's directory.
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


def exploration(population: Population) -> str:
    """With which probability learners of values explore in evaluation, for people; others draw from a
    policy."""
    chances = {
        learner.settings.epsilon_evaluation
        for learner in population.learners.values()
        if not learner.actor.stochastic
    }
    return "".join(f", epsilon {chance:g}" for chance in sorted(chances))
