"""The agents of a training in fresh worlds: at random before it, greedily during it, as trained after it."""

import random as python_random
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from io import BytesIO
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from torchrl.envs import EnvBase

from cprl.commons.game import Game
from cprl.envs.env_state import load_transforms_state, transforms_state
from cprl.envs.make_env import PlayableGame, make_env
from cprl.envs.unwrap import commons_game_of
from cprl.experiment import Experiment
from cprl.experiment.engine import engine_of
from cprl.measuring.playing import Policy, evaluate
from cprl.measuring.registry import INSTITUTIONS
from cprl.measuring.table import labelled
from cprl.measuring.tracker import Episode, try_custom_metrics
from cprl.runs.episodes import EVALUATIONS, table_of
from cprl.runs.files import write_listed
from cprl.training.agents import Population, refuse_other_worlds
from cprl.training.stored import consecutive_groups, stored_policies
from cprl.values import Custom


def make_agents(
    experiment: Experiment, *, starts: bool = True, weights: Mapping[str, str] | None = None
) -> tuple[EnvBase, Population]:
    """Make the worlds of a training and its `Population` of agents; refuse what would fail in the training or
    its evaluation.

    Args:
        starts: whether agents with `start_from` get the stored weights; a resumed training reads its own.
        weights: the names of the weights of `Frozen` agents, see `Population`.
    """
    env = make_worlds(experiment, experiment.replicas * experiment.worlds, device=experiment.device)
    population = Population(
        env,
        experiment.agents,
        seed=experiment.seed,
        worlds=experiment.worlds,
        engine=engine_of(experiment),
        starts=starts,
        weights=weights,
        governor=experiment.governor,
        governor_from_turn=experiment.governor_from_step // experiment.worlds,
    )
    with torch.random.fork_rng(devices=[]):
        fresh_env(experiment)  # refuse what the evaluation cannot play now, not after hours
        population.random_policy(experiment.evaluation_episodes)
        population.policy(experiment.evaluation_episodes)
    return env, population


def make_earlier(experiment: Experiment, env: EnvBase, population: Population) -> list[tuple[EnvBase, int]]:
    """Make the worlds of `Experiment.earlier`, each with its steps; refuse games that differ from that of
    `env` in what agents observe and do, in what scripted ones go by, or in what they report beside
    institutions."""
    made = []
    for index, part in enumerate(experiment.earlier):
        earlier = make_worlds(experiment, env.batch_size.numel(), game=part.game, device=experiment.device)
        name = f"experiment.earlier[{index}].game"
        actors = [part for actor in population.others.values() for part in actor.modules()]
        refuse_other_worlds(earlier, env, name, actors)
        try_custom_metrics(experiment.metrics, earlier)
        made.append((earlier, part.steps))
    return made


def fresh_env(experiment: Experiment) -> EnvBase:
    worlds = experiment.replicas * experiment.evaluation_episodes
    return make_worlds(experiment, worlds, fresh=True, device=experiment.device)


def make_worlds(
    experiment: Experiment,
    count: int,
    *,
    game: PlayableGame | Custom | None = None,
    first: int = 0,
    fresh: bool = False,
    device: str = "cpu",
) -> EnvBase:
    """Return `count` worlds of an experiment's game, with its transforms, from the number `first` on.

    Args:
        game: an earlier game of the experiment instead of the one at the end.
        fresh: whether they are worlds of the evaluation, which no training plays.
    """
    return make_env(
        experiment.game if game is None else game,
        worlds=count,
        seed=experiment.seed + fresh,
        first_world=first,
        device=device,
        transforms=experiment.transforms,
    )


def random_play(
    experiment: Experiment,
    population: Population,
    *,
    seen: Callable[[EnvBase, Policy], Policy] | None = None,
) -> list[Episode]:
    """Let agents that act at random play the worlds of the evaluation, for comparison while the training
    runs; no random generator moves.

    Args:
        seen: returns a policy that acts like the given one in these worlds, and observes it.
    """
    with _restored_generators(experiment.device):
        env = fresh_env(experiment)
        policy: Policy = population.random_policy(experiment.evaluation_episodes)
        if seen is not None:
            policy = seen(env, policy)
        return evaluate(env, policy, metrics=experiment.metrics)


@contextmanager
def _restored_generators(device: str) -> Iterator[None]:
    """Restore the global random generators after the block, since custom games may draw from them."""
    python_state = python_random.getstate()
    numpy_state = np.random.get_state()  # noqa: NPY002  (the global generator is the point)
    gpus = [torch.device(device)] if torch.device(device).type == "cuda" else []
    try:
        with torch.random.fork_rng(devices=gpus):
            yield
    finally:
        python_random.setstate(python_state)
        np.random.set_state(numpy_state)  # noqa: NPY002


class Evaluations:
    """A callback that evaluates agents greedily in fresh episodes every `evaluate_every` episodes of
    training, in the game at the end.

    The replicas that have just ended such an episode play `evaluation_episodes` each, always the same ones,
    like `cprl.evaluate_run(run, Fresh(greedy=True, seed=experiment.seed + 1))`. The training itself does not
    change. The numbers of an evaluation are logged with those of the episode, and the table
    `evaluation/training.parquet` has a row for each of its episodes and agents.
    """

    def __init__(self, run: Path, experiment: Experiment, population: Population) -> None:
        self._run = run
        self._experiment = experiment
        self._population = population
        self._tables: list[pa.Table] = []

    def on_start(self, training: Any) -> None:
        self._training = training

    def on_ended(self, ended: Sequence[tuple[Episode, dict[str, float]]]) -> None:
        every = self._experiment.evaluate_every
        due = {  # if several end in one turn, the last counts
            episode.replica: (episode.episode + 1, learning)
            for episode, learning in ended
            if every is not None and (episode.episode + 1) % every == 0
        }
        if not due:
            return
        with _restored_generators(self._experiment.device):
            played = self._play_fresh(due)
        for replica, episodes in played.items():
            trained_episodes, learning = due[replica]
            learning |= {f"evaluation/{name}": mean for name, mean in _mean_metrics(episodes).items()}
            table = table_of(episodes, [replica])
            self._tables.append(labelled(table, trained_episodes=trained_episodes))
        table = pa.concat_tables(self._tables)
        write_listed(self._run, EVALUATIONS, lambda file: pq.write_table(table, file, compression="zstd"))

    def _play_fresh(self, replicas: Iterable[int]) -> dict[int, list[Episode]]:
        experiment = self._experiment
        worlds = experiment.evaluation_episodes
        seed = experiment.seed + 1
        played: dict[int, list[Episode]] = {}
        for group in consecutive_groups(sorted(replicas)):
            env = make_worlds(experiment, len(group) * worlds, first=group[0] * worlds, fresh=True)
            load_transforms_state(env, transforms_state(self._training.env))
            stored = self._population.as_stored(group)
            playing = self._population.playing
            policies = stored_policies(stored, playing, replicas=group, worlds=worlds, seed=seed)
            episodes = evaluate(env, policies, metrics=experiment.metrics)
            for index, replica in enumerate(group):
                played[replica] = episodes[index * worlds : (index + 1) * worlds]
        return played

    def state_dict(self) -> dict[str, Any]:
        """Return the table so far, as the bytes of a file."""
        file = BytesIO()
        if self._tables:
            pq.write_table(pa.concat_tables(self._tables), file, compression="zstd")
        return {"table": torch.tensor(np.frombuffer(file.getvalue(), np.uint8))}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue with the table of a state; later evaluations are repeated."""
        table = state["table"].numpy().tobytes()
        self._tables = [pq.read_table(BytesIO(table))] if table else []


def _mean_metrics(episodes: Sequence[Episode]) -> dict[str, float]:
    means = {"return": fmean(float(episode.return_.sum()) for episode in episodes)}
    for name in episodes[0].metrics:
        if name.startswith(INSTITUTIONS):
            continue
        values = [episode.metrics[name] for episode in episodes]
        means[name] = float(np.nanmean(values)) if not np.isnan(values).all() else float("nan")
    return means


def is_repeatable(experiment: Experiment) -> bool:
    """Return whether random play before a training leaves the worlds of the evaluation as random play after
    it would: in a `cprl.Game`, which depends on seeds alone, without transforms, which may learn, and without
    ballots, whose results agents see at the start of the next episode."""
    game = experiment.game
    return isinstance(game, Game) and not game.in_force and not experiment.transforms


def _keeps_decisions(env: EnvBase) -> bool:
    game = commons_game_of(env)
    return game is not None and any(ballot.period_episodes != 1 for ballot in game.in_force)


def evaluate_population(
    experiment: Experiment, trained: EnvBase, population: Population, *, random: list[Episode] | None = None
) -> dict[str, list[Episode]]:
    """Let the agents play the fresh episodes of the evaluation in each replica.

    Args:
        trained: the environment of the training, whose transforms have learned.
        random: the episodes of `random_play`, which are reused if they would be the same.

    Returns:
        The episodes by policy: "random", and "trained" for the current agents.
    """
    fresh = fresh_env(experiment)
    worlds = experiment.evaluation_episodes
    load_transforms_state(fresh, transforms_state(trained))
    if random is None or not is_repeatable(experiment):
        random = evaluate(fresh, population.random_policy(worlds), metrics=experiment.metrics)
    else:
        fresh.reset()  # so that trained agents play the second episode of each world
    if _keeps_decisions(trained):
        fresh = fresh_env(experiment)  # so that no decision of random play stays in force
    load_transforms_state(fresh, transforms_state(trained))  # since random play may have changed them
    policy = population.policy(worlds)
    return {"random": random, "trained": evaluate(fresh, policy, explore=True, metrics=experiment.metrics)}


def write_evaluation(
    run: Path, played: Mapping[str, Sequence[Episode]], *, replicas: int
) -> dict[str, pa.Table]:
    """Write `evaluation/<policy>.parquet` of a run, replacing existing files; return the tables by policy."""
    tables = {name: table_of(episodes, range(replicas)) for name, episodes in played.items()}
    for name, table in tables.items():
        write_listed(run, f"evaluation/{name}.parquet", partial(pq.write_table, table))
    return tables
