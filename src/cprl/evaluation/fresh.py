"""Fresh episodes of stored agents, which are filmed, shown and exported; and which of them is typical.

The trained agents of a run may do well in one replica and badly in another: what is shown without a choice is
an episode near the middle, and words say so, and what the others do.
"""

from collections.abc import Mapping, Sequence
from itertools import count
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple

import numpy as np
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from cprl import keys
from cprl.commons.game import Game
from cprl.commons.world import Shown
from cprl.envs.commons_env import CommonsEnv
from cprl.envs.unwrap import commons_of
from cprl.evaluation.evaluate import opened
from cprl.evaluation.lanes import refuse_trained_in
from cprl.experiment import Experiment
from cprl.measuring.episodes import Episode, tracker_of
from cprl.measuring.evaluate import evaluate, turns
from cprl.measuring.registry import COLLECTIVE_RETURN
from cprl.measuring.table import where
from cprl.policies.assignment import AgentPolicies
from cprl.population import AgentSpec
from cprl.runs.episodes import read_rows
from cprl.system.defaults import FILM_SEED as SEED
from cprl.system.output import say
from cprl.system.working import working
from cprl.training.stored import LoadedRun
from cprl.values import Natural, Range, Seed, checked

EPISODES_TRIED: Final = 5
"""The fresh episodes among which a typical one is looked for."""
_MOST_LISTED: Final = 6
"""Replicas whose averages a sentence lists one by one."""


class FreshEpisode(NamedTuple):
    """A fresh world of a run's game, and who plays in it."""

    run: LoadedRun
    env: EnvBase
    """One world, with the run's transforms."""
    policies: AgentPolicies
    replica: int
    episode: int
    is_typical: bool = False
    """Whether it was chosen as the one whose turns and apples are nearest to their medians over replicas."""

    @property
    def words(self) -> str:
        """Which episode it is, and what the trained agents of the run come to on average."""
        known = averages_in_words(self.run)
        if not self.is_typical:
            return f"Replica {self.replica}, episode {self.episode}. {known}".rstrip()
        averages = averages_of(self.run)
        turns, apples = _median(averages)
        middle = "the medians of the replicas" if len(averages) > 1 else "the averages"
        near = f"{middle}, {turns:,.0f} turns and {apples:,.0f} apples"
        chosen = f"chosen of the first {EPISODES_TRIED} for a life and a harvest near {near}"
        which = f"replica {self.replica}, episode {self.episode}"
        return f"A typical episode ({which}), {chosen}. {known}"


def averages_of(run: LoadedRun) -> dict[int, tuple[float, float]]:
    """Return how many turns the trained agents of each replica last and how many apples they pick, on average
    over the run's own evaluation, by replica; {} of a run that has none, or in which nobody learned."""
    path = run.path / "evaluation" / "trained.parquet"
    names = ("survival_steps", COLLECTIVE_RETURN)
    if not run.networks or not path.is_file():
        return {}
    table = read_rows(path)
    if not {*names} <= {*table.column_names}:
        return {}
    means = where(table, replica=tuple(run.replicas)).group_by("replica")
    rows = means.aggregate([(name, "mean") for name in names]).sort_by("replica").to_pylist()
    return {row["replica"]: tuple(row[f"{name}_mean"] for name in names) for row in rows}


def _median(averages: Mapping[int, tuple[float, float]]) -> tuple[float, float]:
    """Return the medians over replicas of the turns and of the apples."""
    turns, apples = np.median([*averages.values()], axis=0).tolist()
    return turns, apples


def averages_in_words(run: LoadedRun) -> str:
    """Return the averages of all replicas in a sentence; "" where there are none."""
    averages = averages_of(run)
    if not averages:
        return ""
    turns, apples = (_listed(numbers) for numbers in zip(*averages.values(), strict=True))
    of_replicas = f" of the {len(averages)} replicas" if len(averages) > 1 else ""
    return f"The trained agents{of_replicas} last {turns} turns on average and pick {apples} apples."


def _listed(numbers: Sequence[float]) -> str:
    """Return numbers in words; of many the least and the greatest."""
    texts = [f"{number:,.0f}" for number in numbers]
    if len(texts) > _MOST_LISTED:
        return f"{min(numbers):,.0f} to {max(numbers):,.0f}"
    return " and ".join(filter(None, [", ".join(texts[:-1]), texts[-1]]))


def unstored(game: Game, agents: Sequence[AgentSpec]) -> LoadedRun:
    """Return a run of scripted agents that stands nowhere on the disk, to be played as stored ones are."""
    experiment = Experiment(name="scripted", game=game, agents=tuple(agents), episodes=1, replicas=1)
    nowhere = Path(experiment.name)
    return LoadedRun(
        path=nowhere,
        experiment=experiment,
        recipe={},
        networks={},
        weights_from=nowhere,
        transforms_state={},
    )


def fresh_episode(
    run: str | Path | LoadedRun,
    *,
    replica: int | None = None,
    episode: int | None = None,
    seed: int | None = None,
) -> FreshEpisode:
    """Return the world and the agents of an episode that is filmed, see `fresh_episodes`."""
    (fresh,) = fresh_episodes([run], replica=replica, episode=episode, seed=seed)
    return fresh


def fresh_episodes(
    runs: Sequence[str | Path | LoadedRun],
    *,
    replica: int | None = None,
    episode: int | None = None,
    seed: int | None = None,
) -> list[FreshEpisode]:
    """Return the worlds and the agents of episodes that are shown together; equal numbers, equal episodes.

    Without `replica` and `episode` it is a typical one: of each run the replica whose average survival in the
    run's own evaluation is nearest to the median over replicas, and of the first five episodes the one whose
    turns and apples are nearest to the medians; the same world for all. Runs in which nobody learned, or
    without an evaluation, show their first replica, and alone the first episode.

    Args:
        replica, episode: if one of them is given, the other is the first.
        seed: of the worlds and all chance, none that a run was trained with; by default 20011, or the next
            with which none was.
    """
    if episode is not None:
        episode = checked("episode", episode, Annotated[int, Range(0, 2**32 - 1)])
    if replica is not None:
        replica = checked("replica", replica, Natural)
    if seed is not None:
        seed = checked("seed", seed, Seed)
    loaded = [opened(run) for run in runs]
    if seed is None:
        seed = fresh_seed(loaded)
    refuse_trained_in(seed, loaded)
    if replica is not None or episode is not None:
        return [_fresh(run, replica, episode or 0, seed) for run in loaded]
    replicas = [typical_replica(run) for run in loaded]
    are_known = [bool(averages_of(run)) for run in loaded]

    def played(tried: int) -> list[FreshEpisode]:
        """Return an episode of all runs, each with its typical replica."""
        each = zip(loaded, replicas, are_known, strict=True)
        return [_fresh(run, number, tried, seed)._replace(is_typical=known) for run, number, known in each]

    def distance(tried: int) -> float:
        """Return how far the turns and the apples of an episode of all runs are from the medians."""
        return sum(_distance(fresh) for fresh in played(tried) if fresh.is_typical)

    return played(min(range(EPISODES_TRIED), key=distance) if any(are_known) else 0)


def fresh_seed(runs: Sequence[LoadedRun], first: int = SEED) -> int:
    """Return the first seed from one on with which none of the runs was trained."""
    trained = {run.experiment.seed for run in runs}
    return next(seed for seed in count(first) if seed not in trained)


def typical_replica(run: LoadedRun) -> int:
    """Return the replica whose average survival is nearest to the median over replicas, of equal ones that
    whose harvest is; the first of a run without an evaluation of learned agents."""
    averages = averages_of(run)
    if not averages:
        return run.replicas[0]
    turns, apples = _median(averages)
    return min(averages, key=lambda one: (abs(averages[one][0] - turns), abs(averages[one][1] - apples)))


def _fresh(run: LoadedRun, replica: int | None, episode: int, seed: int) -> FreshEpisode:
    if replica is None:
        replica = run.replicas[0]
    if replica not in run.replicas:
        replicas = ", ".join(map(str, run.replicas))
        raise ValueError(f"replica is {replica}; allowed: {replicas}, the replicas of {run.path}")
    env = run.env(1, seed=seed, first_world=episode)
    return FreshEpisode(run, env, run.policy(replica, seed=seed + episode), replica, episode)


def _distance(fresh: FreshEpisode) -> float:
    """Play an episode; return how far its turns and its apples are from their medians, in shares of these."""
    median = _median(averages_of(fresh.run))
    (played,) = evaluate(fresh.env, fresh.policies, explore=True)
    reached = np.array([played.steps, played.metrics[COLLECTIVE_RETURN]])
    return float(np.sum(np.abs(reached - median) / np.maximum(1.0, median)))


class Recorded(NamedTuple):
    """An episode of T turns of N agents that was played to be shown."""

    batches: list[TensorDictBase]
    """What happened in each turn, batch size [1]."""
    boards: list[Shown]
    """The board as the episode began, then after each turn, without what agents observe; none of a game
    without a board."""
    episode: Episode

    def entry(self, *key: str, lacking: Any = None) -> Any:
        """Return an entry of all turns, [T, ...]; another value where the game has none."""
        if self.batches[0].get(key, None) is None:
            return lacking
        return np.stack([batch[key][0].numpy(force=True) for batch in self.batches])

    @property
    def last(self) -> int:
        """The last turn."""
        return len(self.batches)

    @property
    def left(self) -> int:
        """Apples on the board at the end."""
        return int(self.boards[-1].stock.sum())

    @property
    def is_dead(self) -> bool:
        """Whether the board died, since no apple was left and none could grow."""
        return self.episode.terminated and self.left == 0

    def since_the_start(self, *key: str) -> Any:
        """Return an entry of agents at the start and after each turn, [T + 1, N]; zeros where the game has
        none."""
        values = self.entry(*key, lacking=np.zeros(self.entry(*keys.ACTION).shape))
        return np.concatenate([np.zeros_like(values[:1]), values])


@working("playing an episode")
def record(fresh: FreshEpisode) -> Recorded:
    """Play an episode, and keep all that happened."""
    commons = commons_of(fresh.env)
    tracker = tracker_of(fresh.env, fresh.run.metrics)
    played = turns(fresh.env, fresh.policies)
    boards = [] if commons is None else [board_now(commons)]
    batches = []
    ended: list[Episode] = []
    for batch in played:
        ended += tracker.add(batch)
        batches.append(batch.clone())
        if commons is not None:
            boards.append(board_now(commons))
    return Recorded(batches, boards, ended[0])


def board_now(env: CommonsEnv) -> Shown:
    """Return the board of one world without what agents observe."""
    board = env.worlds.show(env.output)
    return board._replace(observation=board.observation[:0])


def say_which(fresh: Sequence[FreshEpisode]) -> None:
    """Print which episode of each run is shown, and what its agents come to on average."""
    for one in fresh:
        say(f"{f'{one.run.path}: ' if len(fresh) > 1 else ''}{one.words}")
