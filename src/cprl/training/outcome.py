"""The agents of a training in fresh worlds: by chance before it, greedily meanwhile, as trained after it."""

import random as random_of_python
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from io import BytesIO
from pathlib import Path
from statistics import fmean
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from torchrl.envs import EnvBase

from cprl.commons.game import Game
from cprl.envs.make_env import make_env
from cprl.envs.state import load_transforms_state, transforms_state
from cprl.envs.unwrap import commons_of
from cprl.experiment import Experiment
from cprl.experiment.engine import engine_of
from cprl.measuring.episodes import Episode
from cprl.measuring.evaluate import Policy, evaluate
from cprl.measuring.registry import INSTITUTIONS
from cprl.measuring.table import labelled
from cprl.policies.present import PresentPolicy
from cprl.runs.episodes import EVALUATIONS, table_of
from cprl.runs.files import write_listed
from cprl.training.agents import Population
from cprl.training.stored import in_a_row, stored_policies

EXHIBITED_WORLD: Final = 2**31
"""The number of the exhibited world; those of a training, of as many replicas, are smaller."""


def make_agents(
    experiment: Experiment, *, starts: bool = True, weights: Mapping[str, str] | None = None
) -> tuple[EnvBase, Population]:
    """Make the worlds of a training and its agents; refuse what does not fit, in the evaluation too.

    Args:
        starts: whether agents start with the weights of stored ones, where they ask for it; a training that
            is resumed reads its own.
        weights: those that `Frozen` agents play with, see `Population`.
    """
    env = _worlds(experiment, experiment.replicas * experiment.worlds, device=experiment.device)
    population = Population(
        env,
        experiment.agents,
        seed=experiment.seed,
        worlds=experiment.worlds,
        engine=engine_of(experiment),
        starts=starts,
        weights=weights,
    )
    with torch.random.fork_rng(devices=[]):
        fresh_env(experiment)  # what the evaluation cannot have is refused now, not after hours
        population.random_policy(experiment.evaluation_episodes)
        population.policy(experiment.evaluation_episodes)
    return env, population


def fresh_env(experiment: Experiment) -> EnvBase:
    worlds = experiment.replicas * experiment.evaluation_episodes
    return _worlds(experiment, worlds, fresh=True, device=experiment.device)


def _worlds(
    experiment: Experiment, count: int, *, first: int = 0, fresh: bool = False, device: str = "cpu"
) -> EnvBase:
    return make_env(
        experiment.game,
        worlds=count,
        seed=experiment.seed + fresh,
        first_world=first,
        device=device,
        transforms=experiment.transforms,
    )


def exhibited(
    experiment: Experiment, trained: EnvBase, population: Population
) -> tuple[PresentPolicy, EnvBase] | None:
    """Return the current policy, and one world for it that neither training nor evaluation plays; None where
    the game has no board. Torch's generator is left as it was."""
    if commons_of(trained) is None:
        return None
    with torch.random.fork_rng(devices=[]):
        env = _worlds(experiment, 1, first=EXHIBITED_WORLD, device=experiment.device)
        return population.present_policy(), env


def random_play(
    experiment: Experiment,
    population: Population,
    *,
    seen: Callable[[EnvBase, Policy], Policy] | None = None,
) -> list[Episode]:
    """Let agents who take every action with equal probability play the worlds of the evaluation, before the
    training: what it is compared with while it runs. No generator moves.

    Args:
        seen: Returns the policy that is played in the place of theirs, in these worlds, and looks on.
    """
    with _generators_kept(experiment.device):
        env = fresh_env(experiment)
        policy: Policy = population.random_policy(experiment.evaluation_episodes)
        if seen is not None:
            policy = seen(env, policy)
        return evaluate(env, policy, metrics=experiment.metrics)


@contextmanager
def _generators_kept(device: str) -> Iterator[None]:
    """Put the global generators back where they were: games of somebody else's may draw from them."""
    of_python = random_of_python.getstate()
    of_numpy = np.random.get_state()  # noqa: NPY002  (the global generator is the point)
    gpus = [torch.device(device)] if torch.device(device).type == "cuda" else []
    try:
        with torch.random.fork_rng(devices=gpus):
            yield
    finally:
        random_of_python.setstate(of_python)
        np.random.set_state(of_numpy)  # noqa: NPY002


class Evaluations:
    """Lets agents play fresh episodes greedily after every so many episodes of their training; a callback.

    The replicas that have just ended such an episode play `evaluation_episodes` each, always the same ones,
    as `cprl.evaluate_run(run, Fresh(greedy=True, seed=experiment.seed + 1))` would let them. Nothing of the
    training changes. The numbers of an evaluation are logged with those of the episode, and the table
    `evaluation/training.parquet` has a row for each of its episodes and agents.
    """

    def __init__(self, run: Path, experiment: Experiment, env: EnvBase, population: Population) -> None:
        self._run = run
        self._experiment = experiment
        self._env = env
        self._population = population
        self._tables: list[pa.Table] = []

    def on_ended(self, ended: Sequence[tuple[Episode, dict[str, float]]]) -> None:
        every = self._experiment.evaluate_every
        due = {  # of several in one turn the last
            episode.replica: (episode.episode + 1, learning)
            for episode, learning in ended
            if every is not None and (episode.episode + 1) % every == 0
        }
        if not due:
            return
        with _generators_kept(self._experiment.device):
            played = self._play(due)
        for replica, episodes in played.items():
            trained_episodes, learning = due[replica]
            learning |= {f"evaluation/{name}": mean for name, mean in _means(episodes).items()}
            table = table_of(episodes, [replica])
            self._tables.append(labelled(table, trained_episodes=trained_episodes))
        table = pa.concat_tables(self._tables)
        write_listed(self._run, EVALUATIONS, lambda file: pq.write_table(table, file, compression="zstd"))

    def _play(self, replicas: Iterable[int]) -> dict[int, list[Episode]]:
        experiment = self._experiment
        worlds = experiment.evaluation_episodes
        seed = experiment.seed + 1
        played: dict[int, list[Episode]] = {}
        for group in in_a_row(sorted(replicas)):
            env = _worlds(experiment, len(group) * worlds, first=group[0] * worlds, fresh=True)
            load_transforms_state(env, transforms_state(self._env))
            agents = self._population.as_stored(group)
            playing = self._population.playing
            policies = stored_policies(agents, playing, replicas=group, worlds=worlds, seed=seed)
            episodes = evaluate(env, policies, metrics=experiment.metrics)
            for place, replica in enumerate(group):
                played[replica] = episodes[place * worlds : (place + 1) * worlds]
        return played

    def state_dict(self) -> dict[str, Any]:
        """Return the table so far, as the bytes of a file."""
        file = BytesIO()
        if self._tables:
            pq.write_table(pa.concat_tables(self._tables), file, compression="zstd")
        return {"table": torch.tensor(np.frombuffer(file.getvalue(), np.uint8))}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue with the table of a state; what was evaluated after it is evaluated again."""
        table = state["table"].numpy().tobytes()
        self._tables = [pq.read_table(BytesIO(table))] if table else []


def _means(episodes: Sequence[Episode]) -> dict[str, float]:
    means = {"return": fmean(float(episode.return_.sum()) for episode in episodes)}
    for name in episodes[0].metrics:
        if name.startswith(INSTITUTIONS):
            continue
        values = [episode.metrics[name] for episode in episodes]
        means[name] = float(np.nanmean(values)) if not np.isnan(values).all() else float("nan")
    return means


def is_same_later(experiment: Experiment) -> bool:
    """Return whether random play is the same before and after a training: the game is a `cprl.Game`, whose
    chance depends on seeds alone, and has no transforms, which may learn in between."""
    return isinstance(experiment.game, Game) and not experiment.transforms


def _keeps_decisions(env: EnvBase) -> bool:
    commons = commons_of(env)
    return commons is not None and any(ballot.period_episodes > 1 for ballot in commons.game.ballots)


def evaluate_population(
    experiment: Experiment, trained: EnvBase, population: Population, *, random: list[Episode] | None = None
) -> dict[str, list[Episode]]:
    """Let the agents play fresh episodes, so many of each replica.

    Args:
        trained: the environment of the training; what its transforms have learned is used.
        random: the episodes of `random_play`, which are not played again if they are the same now.

    Returns:
        The episodes by policy: "random", and "trained", everybody as they are now.
    """
    fresh = fresh_env(experiment)
    worlds = experiment.evaluation_episodes
    load_transforms_state(fresh, transforms_state(trained))
    if random is None or not is_same_later(experiment):
        random = evaluate(fresh, population.random_policy(worlds), metrics=experiment.metrics)
    elif not _keeps_decisions(trained):
        fresh.reset()  # the trained agents play the second episode of each world
    if _keeps_decisions(trained):
        fresh = fresh_env(experiment)  # or its first one, where what others decided would stay in force
    load_transforms_state(fresh, transforms_state(trained))  # which random play may have changed
    policy = population.policy(worlds)
    return {"random": random, "trained": evaluate(fresh, policy, explore=True, metrics=experiment.metrics)}


def write_evaluation(
    run: Path, played: Mapping[str, Sequence[Episode]], *, replicas: int
) -> dict[str, pa.Table]:
    """Write `evaluation/<policy>.parquet` of a run of so many replicas, again where one is there; return the
    tables by policy."""
    tables = {name: table_of(episodes, range(replicas)) for name, episodes in played.items()}
    for name, table in tables.items():
        write_listed(run, f"evaluation/{name}.parquet", partial(pq.write_table, table))
    return tables
