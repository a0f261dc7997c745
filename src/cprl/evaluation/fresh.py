"""Chooses and plays one fresh episode of stored agents, to be filmed, shown or exported.

The trained agents of a run may do well in one replica and badly in another. By default the episode is
therefore a typical one, near the medians of the replicas, and its description says how the replicas differ.
Of a run with people it is one that they played, replayed by the actions that the run keeps.
"""

from collections.abc import Mapping, Sequence
from itertools import count
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple

import numpy as np
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from cprl import keys
from cprl.commons.world import WorldView
from cprl.envs.commons_env import CommonsEnv
from cprl.envs.unwrap import commons_of
from cprl.evaluation.populations import refuse_trained_in
from cprl.measuring.playing import evaluate, turns
from cprl.measuring.registry import COLLECTIVE_RETURN
from cprl.measuring.table import where
from cprl.measuring.tracker import Episode, tracker_of
from cprl.policies.joint_policy import JointPolicy
from cprl.policies.recorded_policy import RecordedPolicy
from cprl.population import has_people
from cprl.runs.episodes import read_rows, read_table
from cprl.runs.played import TURNS
from cprl.system.defaults import FILM_SEED
from cprl.system.output import say
from cprl.system.working import working
from cprl.training.stored import LoadedRun, as_loaded
from cprl.values import Natural, Range, Seed, checked, refusal
from cprl.values.array_types import AnyArray, Bool

EPISODES_TRIED: Final = 5
"""The number of fresh episodes from which a typical one is chosen."""
_MOST_LISTED: Final = 6
"""The largest number of replicas whose averages a sentence lists one by one."""


class FreshEpisode(NamedTuple):
    """An episode that can be played: a fresh world of a run's game, and the policies of its agents."""

    run: LoadedRun
    env: EnvBase
    """One world, with the run's transforms."""
    policies: JointPolicy
    replica: int
    episode: int
    is_typical: bool = False
    """Whether it was chosen because its turns and apples are nearest to their medians over replicas."""

    @property
    def description(self) -> str:
        """Return sentences that name the episode and say the averages of the run's trained agents."""
        averages_sentence = averages_in_words(self.run)
        if has_people(self.run.specs):
            return f"Group {self.replica}, as people played it. {averages_sentence}"
        if not self.is_typical:
            return f"Replica {self.replica}, episode {self.episode}. {averages_sentence}".rstrip()
        averages = averages_of(self.run)
        survival, apples = _median(averages)
        middle = "the medians of the replicas" if len(averages) > 1 else "the averages"
        near = f"{middle}, {survival:,.0f} turns and {apples:,.0f} apples"
        reason = f"chosen of the first {EPISODES_TRIED} for a life and a harvest near {near}"
        numbers = f"replica {self.replica}, episode {self.episode}"
        return f"A typical episode ({numbers}), {reason}. {averages_sentence}"


def averages_of(run: LoadedRun) -> dict[int, tuple[float, float]]:
    """Return the average turns and apples of people, or in the evaluation of trained agents, by replica.

    Return {} for a run without an evaluation, or in which nobody learned.
    """
    path = run.path / "evaluation" / "trained.parquet"
    metrics = ("survival_steps", COLLECTIVE_RETURN)
    if has_people(run.specs):
        table = run.episodes()
    elif run.networks and path.is_file():
        table = read_rows(path)
    else:
        return {}
    if not set(metrics) <= set(table.column_names):
        return {}
    groups = where(table, replica=tuple(run.replicas)).group_by("replica")
    rows = groups.aggregate([(metric, "mean") for metric in metrics]).sort_by("replica")
    survival, apples = (rows[f"{metric}_mean"].to_pylist() for metric in metrics)
    return dict(zip(rows["replica"].to_pylist(), zip(survival, apples, strict=True), strict=True))


def _median(averages: Mapping[int, tuple[float, float]]) -> tuple[float, float]:
    """Return the medians over replicas of the turns and of the apples."""
    survival, apples = np.median([*averages.values()], axis=0).tolist()
    return survival, apples


def averages_in_words(run: LoadedRun) -> str:
    """Return a sentence with the averages of all replicas; "" for a run without an evaluation."""
    averages = averages_of(run)
    if not averages:
        return ""
    survival, apples = map(_list_in_words, zip(*averages.values(), strict=True))
    agents, noun = ("people", "groups") if has_people(run.specs) else ("trained agents", "replicas")
    replicas = f" of the {len(averages)} {noun}" if len(averages) > 1 else ""
    return f"The {agents}{replicas} last {survival} turns on average and pick {apples} apples."


def _list_in_words(numbers: Sequence[float]) -> str:
    """Return numbers as "1, 2 and 3", or "1 to 9" if there are many."""
    texts = [f"{number:,.0f}" for number in numbers]
    if len(texts) > _MOST_LISTED:
        return f"{min(numbers):,.0f} to {max(numbers):,.0f}"
    return " and ".join(filter(None, [", ".join(texts[:-1]), texts[-1]]))


def fresh_episodes(
    runs: Sequence[str | Path | LoadedRun],
    *,
    replica: int | None = None,
    episode: int | None = None,
    seed: int | None = None,
) -> list[FreshEpisode]:
    """Return fresh episodes of several runs that are shown together, all in the same world.

    By default they are typical. For each run the replica is chosen whose average survival in the run's
    evaluation is nearest to the median over replicas; then, of the first five episodes, the one whose turns
    and apples are nearest to the medians of all runs. A run in which nobody learned, or without an
    evaluation, shows its first replica. If no run has an evaluation, the first episode is shown.

    Args:
        runs: directories, exported results, or values of `cprl.load`.
        replica: the number of the replica, or group of people; 0 by default if `episode` is given.
        episode: the number of the episode; 0 by default if `replica` is given.
        seed: the seed of the worlds and of all random choices, with which no run may have been trained; by
            default `FILM_SEED`, or the next seed that differs from all training seeds. The same numbers give
            the same episodes.

    Raises:
        ValueError: for a replica that a run lacks, a seed with which it was trained, an episode or a seed of
            a run with people, or turns of people that do not give what they played.
    """
    episode = checked("episode", episode, Annotated[int, Range(0, 2**32 - 1)] | None)
    replica = checked("replica", replica, Natural | None)
    seed = checked("seed", seed, Seed | None)
    loaded = [as_loaded(run) for run in runs]
    for name, value in (("episode", episode), ("seed", seed)):
        if value is not None and any(has_people(run.specs) for run in loaded):
            raise refusal(name, value, "None with people, who play no fresh worlds; replica is their group")
    if seed is None:
        seed = fresh_seed(loaded)
    refuse_trained_in(seed, loaded)
    if replica is not None or episode is not None:
        return [_fresh_episode(run, replica, episode or 0, seed) for run in loaded]
    return _typical_episodes(loaded, seed)


def _typical_episodes(runs: Sequence[LoadedRun], seed: int) -> list[FreshEpisode]:
    """Return episodes of the runs' typical replicas in the world that is nearest to their medians."""

    def episodes_in_world(world: int) -> list[FreshEpisode]:
        return [
            _fresh_episode(run, typical_replica(run), world, seed)._replace(is_typical=bool(averages_of(run)))
            for run in runs
        ]

    def distance(world: int) -> float:
        return sum(_distance(episode) for episode in episodes_in_world(world) if episode.is_typical)

    tried = EPISODES_TRIED if any(map(averages_of, runs)) else 1
    return episodes_in_world(min(range(tried), key=distance))


def fresh_seed(runs: Sequence[LoadedRun], first: int = FILM_SEED) -> int:
    """Return the smallest seed from `first` on with which none of the runs was trained."""
    training_seeds = {run.experiment.seed for run in runs}
    return next(seed for seed in count(first) if seed not in training_seeds)


def typical_replica(run: LoadedRun) -> int:
    """Return the replica whose average survival is nearest to the median over replicas.

    If several are equally near, their harvests decide. For a run without an evaluation of trained agents,
    return the first replica.
    """
    averages = averages_of(run)
    if not averages:
        return run.replicas[0]
    median = _median(averages)
    return min(averages, key=lambda replica: np.abs(np.subtract(averages[replica], median)).tolist())


def _fresh_episode(run: LoadedRun, replica: int | None, episode: int, seed: int) -> FreshEpisode:
    """Return an episode of a run's replica, by default of its first one; refuse a replica that it lacks."""
    if replica is None:
        replica = run.replicas[0]
    if replica not in run.replicas:
        replicas = ", ".join(map(str, run.replicas))
        raise ValueError(f"replica is {replica}; allowed: {replicas}, the replicas of {run.path}")
    if has_people(run.specs):
        return _replayed(run, replica)
    env = run.env(1, seed=seed, first_world=episode)
    return FreshEpisode(run, env, run.policy(replica, seed=seed + episode), replica, episode)


def _replayed(run: LoadedRun, group: int) -> FreshEpisode:
    """Return the episode that a group of people played; refuse turns that give another one."""
    path = run.path / TURNS
    if not path.is_file():
        raise ValueError(f"{path} does not exist; without it people cannot be played again")
    rows = where(read_table(path), group=group).sort_by([("turn", "ascending"), ("agent", "ascending")])
    stored = where(run.episodes(), replica=group)
    steps = stored["steps"][0].as_py()
    if len(rows) != steps * run.game.agents:
        raise ValueError(
            f"{path} has {len(rows)} rows of group {group}; allowed: {steps} turns of all agents"
        )
    choices: dict[Any, AnyArray] = {keys.ACTION: rows["action"].to_numpy().reshape(steps, 1, -1)}
    if run.game.decisions:
        choices[keys.DECISION] = rows["decision"].to_numpy().reshape(steps, 1, -1)
    if run.experiment.governor is not None:
        choices[keys.RULE] = rows["rule"].to_numpy().reshape(steps, -1)[:, :1]

    def make_episode() -> FreshEpisode:
        env = run.env(seed=run.experiment.seed, first_world=group)
        return FreshEpisode(run, env, RecordedPolicy(choices), group, 0)

    (episode,) = evaluate(make_episode().env, make_episode().policies)
    if episode.harvest is None or episode.harvest.tolist() != stored["harvest"].to_pylist():
        raise ValueError(
            f"{path} is not what group {group} played: replayed, the harvest is {episode.outcome}"
        )
    return make_episode()


def _distance(fresh_episode: FreshEpisode) -> float:
    """Play an episode; return the sum of the distances of its turns and apples to their medians.

    A distance is relative to its median.
    """
    median = _median(averages_of(fresh_episode.run))
    (played,) = evaluate(fresh_episode.env, fresh_episode.policies, explore=True)
    outcome = np.array([played.steps, played.metrics[COLLECTIVE_RETURN]])
    return float(np.sum(np.abs(outcome - median) / np.maximum(1.0, median)))


class Recorded(NamedTuple):
    """A played episode of T turns and N agents, with the data of all its turns."""

    batches: list[TensorDictBase]
    """The step of each turn, batch size [1]."""
    boards: list[WorldView]
    """The board at the start and after each turn, T + 1 in all, without the agents' observations; empty for a
    game without a board."""
    episode: Episode
    """The episode's length, outcome and metrics."""

    def entry(self, *key: str, lacking: Any = None) -> Any:
        """Return an entry of all turns, [T, ...]; the value `lacking` if the game has no such entry."""
        if self.batches[0].get(key, None) is None:
            return lacking
        return np.stack([batch[key][0].numpy(force=True) for batch in self.batches])

    @property
    def last_turn(self) -> int:
        """Return the number of the last turn, counted from 1."""
        return len(self.batches)

    @property
    def apples_left(self) -> int:
        """Return the number of apples on the board at the end."""
        return int(self.boards[-1].stock.sum())

    @property
    def is_dead(self) -> bool:
        """Return whether the board died: no apple was left and none could grow."""
        return self.episode.terminated and self.apples_left == 0

    @property
    def violated(self) -> Bool:
        """Return who broke a rule in the turn before each board, bool [T + 1, N]."""
        return np.asarray(self.since_the_start("next", *keys.VIOLATED) > 0)

    def since_the_start(self, *key: str) -> Any:
        """Return an entry of agents after each turn, with zeros for the start, [T + 1, N].

        All values are zeros if the game has no such entry.
        """
        values = self.entry(*key, lacking=np.zeros(self.entry(*keys.ACTION).shape))
        return np.concatenate([np.zeros_like(values[:1]), values])


@working("playing an episode")
def record(fresh_episode: FreshEpisode) -> Recorded:
    """Play an episode and return it with all its turns."""
    env = fresh_episode.env
    commons = commons_of(env)
    tracker = tracker_of(env, fresh_episode.run.metrics)
    played = turns(env, fresh_episode.policies)
    boards = [] if commons is None else [board_now(commons)]
    batches = []
    ended: list[Episode] = []
    for batch in played:
        ended += tracker.add(batch)
        batches.append(batch.clone())
        if commons is not None:
            boards.append(board_now(commons))
    return Recorded(batches, boards, ended[0])


def board_now(env: CommonsEnv) -> WorldView:
    """Return the current board of the first world, without the agents' observations."""
    board = env.worlds.show(env.output)
    return board._replace(observation=board.observation[:0])


def print_descriptions(episodes: Sequence[FreshEpisode]) -> None:
    """Print which episode of each run is shown, and the averages of its trained agents."""
    for episode in episodes:
        run = f"{episode.run.path}: " if len(episodes) > 1 else ""
        say(f"{run}{episode.description}")
