"""What do the files of finished runs say? A `Result`: runs of one experiment, all their replicas together."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from measures import Measures, measures_at_play, training_measures
from published import PublishedExperiment, published_experiment

from cprl import presets
from cprl.algorithms import DQN
from cprl.commons.game import Game
from cprl.experiment import Experiment
from cprl.measuring.windows import SMOOTHED_EPISODES, running_mean
from cprl.population import Learning, Scripted, Team, exploration_steps
from cprl.runs.curves import as_curves, curves_of, episode_reached
from cprl.runs.episodes import read_episodes
from cprl.runs.files import read_json
from cprl.runs.recipe import read_recipe
from cprl.runs.weights import lacks_weights
from cprl.studies.study import NOT_IN_CHECKSUM, Condition
from cprl.system.defaults import SEED
from cprl.values.array_types import Float64

PUBLISHED_GAMMA: Final = 0.995
"""The discount of the study's text; titles name others."""
TOO_FEW: Final = "too few episodes"
LAST: Final = 500
"""The episodes at the end of a training that stand for what was learned."""
_LONGEST_NAME: Final = 80
"""The longest name of a pool in characters; figures are named after it."""


@dataclass(kw_only=True, eq=False)
class Result:
    """What the files of finished runs of one experiment say; runs of several seeds count together."""

    paths: Sequence[Path]
    """The directories of the runs."""
    recipe: Mapping[str, Any]
    """The recipe of the first run, like the next two."""
    experiment: Experiment
    report: Mapping[str, Any]
    curves: Mapping[str, Float64]
    """Each metric of all replicas, [R, E]."""
    study: PublishedExperiment | None
    """The study's experiment that it repeats, see `repeated_experiment`."""

    @property
    def name(self) -> str:
        """Return the names of the runs' directories, or that of the first and the number of others."""
        whole = "+".join(path.name for path in self.paths)
        return whole if len(whole) <= _LONGEST_NAME else f"{self.paths[0].name}+{len(self.paths) - 1} more"

    @property
    def title(self) -> str:
        """Return what was run, in a few words."""
        replicas, episodes = self.curves["collective_return"].shape
        parts = [self.recipe["recipe"]]
        if self.variant is not None:
            parts.append(f"{self.variant} rules")
        algorithm = self.algorithm
        if isinstance(algorithm, DQN):
            settings = algorithm.settings
            parts.append(f"targets replaced every {settings.target_every_episodes} episodes")
            parts.append(f"epsilon decays in {settings.epsilon_decay_steps:,} steps")
            if settings.gamma != PUBLISHED_GAMMA:
                parts.append(f"gamma {settings.gamma:g}")
            if settings.optimizer != "adam":
                parts.append(settings.optimizer)
            if algorithm.loss_function != "l2":
                parts.append(algorithm.loss_function)
        return ", ".join([*parts, f"{replicas} replicas of {episodes:,} episodes"])

    @property
    def algorithm(self) -> Any:
        """Return the algorithm of the first agent that learns by itself, or None."""
        specs = (spec for spec in self.experiment.agents if isinstance(spec, Learning))
        return next((spec.algorithm for spec in specs), None)

    @property
    def learns(self) -> bool:
        """Return whether any of its agents learns."""
        return any(isinstance(spec, Learning | Team) for spec in self.experiment.agents)

    @property
    def variant(self) -> str | None:
        """Return the variant of the study's rules that its game has, None for others."""
        return presets.variant_of(self.experiment.game)

    @property
    def random_game(self) -> Game | None:
        """Return the game of which the study gives a random score; None if it gives none, or the game has
        rules that random play is not played with."""
        game = self.experiment.game
        is_scored = self.study is not None and self.study.random is not None
        return game if is_scored and isinstance(game, Game) and not game.institutions else None

    @property
    def is_whole(self) -> bool:
        """Return whether it has as many episodes as the study's experiment, or more."""
        return self.study is not None and self.curves["collective_return"].shape[1] >= self.study.episodes

    def over_training(self, metric: str) -> Float64:
        """Return the mean of a metric over the training of each replica, [R]; of a longer training than the
        study's, over as many episodes as that has."""
        means: Float64 = self.curves[metric][:, : self.study.episodes if self.study else None].mean(1)
        return means

    def at_end(self, metric: str) -> Float64:
        """Return the mean of a metric over the last episodes of each replica, [R]."""
        means: Float64 = self.curves[metric][:, -LAST:].mean(1)
        return means

    @property
    def window(self) -> int:
        """Return the window of its running means in episodes: that of the published curves, if there are
        any."""
        return self.study.window_episodes if self.study else SMOOTHED_EPISODES

    def smoothed(self, metric: str) -> Float64:
        """Return running means of a metric, [R, E]."""
        return running_mean(self.curves[metric], self.window)

    @property
    def exploration_ends(self) -> float | None:
        """Return the episode in which the last epsilon reaches its end, the mean of replicas; None if none
        does."""
        ends = exploration_steps(self.experiment.agents)
        ended = self.curves["survival_steps"].cumsum(1)  # in one world episodes follow each other
        return None if ends is None else episode_reached(ended, ends)

    @cached_property
    def measures(self) -> Measures:
        """Return measures of its training, and of agents at play where all runs have weights: each run's in
        worlds of seeds that no other has, so that replicas are independent."""
        training = training_measures(self.curves, window=self.window)
        if any(lacks_weights(path) for path in self.paths):
            return Measures(training=training, trained={}, random={})
        played = [measures_at_play(path, seed=SEED + place) for place, path in enumerate(self.paths)]
        trained, random = map(joined, zip(*played, strict=True))
        return Measures(training=training, trained=trained, random=random)

    def by_agent(self, column: str) -> Float64 | None:
        """Return a column of the table of episodes, float64 [R, E, N]; None if a run has no such column."""
        if not all(column in table.column_names for table in self._tables):
            return None
        episodes = self.curves["survival_steps"].shape[1]
        return np.concatenate([_by_agent(table, column)[:, :episodes] for table in self._tables])

    @cached_property
    def _tables(self) -> list[pa.Table]:
        return list(map(read_episodes, self.paths))

    def evaluated(self, policy: str) -> Mapping[str, Float64] | None:
        """Return the mean of each metric and replica in its evaluation, [R] by name; None without one.

        Args:
            policy: "random" or "trained".
        """
        paths = [path / "evaluation" / f"{policy}.parquet" for path in self.paths]
        if not all(path.exists() for path in paths):
            return None
        curves = joined([as_curves(pq.read_table(path)) for path in paths])
        return {name: running_mean(values, values.shape[1])[:, 0] for name, values in curves.items()}


def _by_agent(table: pa.Table, column: str) -> Float64:
    """Return a column of a table of episodes, float64 [R, E, N]; NaN where a replica has ended fewer."""
    replica, episode, agent = (table[name].to_numpy() for name in ("replica", "episode", "agent"))
    row = np.unique(replica, return_inverse=True)[1]
    values = np.full((row.max() + 1, episode.max() + 1, agent.max() + 1), np.nan)
    values[row, episode, agent] = table[column].to_numpy(zero_copy_only=False)
    return values


def joined(tables: Sequence[Mapping[str, Float64]]) -> dict[str, Float64]:
    """Return the names that all tables have, with the replicas of all."""
    names = set.intersection(*map(set, tables))
    columns = {name: map(itemgetter(name), tables) for name in tables[0] if name in names}
    return {name: np.concatenate(list(parts)) for name, parts in columns.items()}


def read_result(path: Path) -> Result:
    """Read a run's directory, or its exported results.

    Raises:
        ValueError: If the path has no run, or one of a game without harvest; for code that is not allowed.
        FileNotFoundError: If the run has no episodes or has not ended.
    """
    recipe = read_recipe(path)
    curves = curves_of(path)
    if "collective_return" not in curves:
        raise ValueError(
            f"{path} plays a game that reports no harvest; allowed in a report beside the published study: a "
            "commons; evaluate_run and crossplay measure the returns of others"
        )
    experiment = Experiment.from_recipe(recipe, directory=path)
    return Result(
        paths=[path],
        recipe=recipe,
        experiment=experiment,
        report=read_json(path / "report.json"),
        curves=curves,
        study=repeated_experiment(recipe["recipe"], experiment),
    )


def repeated_experiment(recipe: str, experiment: Experiment) -> PublishedExperiment | None:
    """Return the study's experiment that a run repeats, None for others.

    It repeats one by the name of its recipe, if it plays on the study's map, which has the number of agents,
    whatever the rules; or since it plays a variant of the study's game, beam included, with as many agents
    that learn by DQN, whatever their settings.
    """
    game = experiment.game
    if not isinstance(game, Game):
        return None
    by_name = published_experiment(recipe)
    if by_name is not None and game.map == presets.game(by_name.board).map:
        return by_name
    if presets.variant_of(game) is None or (game.agents > 1 and not game.rules.may_fire):
        return None
    learns = [isinstance(spec, Learning) and isinstance(spec.algorithm, DQN) for spec in experiment.agents]
    if all(learns):
        boards = (board for board in presets.BOARDS if presets.game(board).map == game.map)
        return published_experiment(next(boards))
    is_against_random = learns == [True, False] and experiment.agents[1] == Scripted("random")
    return published_experiment("two_against_random") if is_against_random else None


def pooled(results: Sequence[Result]) -> list[Result]:
    """Return results of which those of one experiment are one, in the place of the first.

    An experiment is one whatever its runs are called, but what repeats an experiment of the study is pooled
    only with what repeats it, too.

    Raises:
        ValueError: for two runs of one experiment with the same seed, whose replicas are the same.
    """
    groups: dict[tuple[str, int | None], list[Result]] = {}
    for result in results:
        number = None if result.study is None else result.study.number
        group = groups.setdefault((Condition(result.experiment).checksum, number), [])
        same = [other.paths[0] for other in group if other.experiment.seed == result.experiment.seed]
        if same:
            raise ValueError(
                f"runs has {same[0]} and {result.paths[0]}, of one experiment and both of seed "
                f"{result.experiment.seed}, which have the same replicas; allowed in a pool: each seed once"
            )
        group.append(result)
    return list(map(_together, groups.values()))


def _together(group: Sequence[Result]) -> Result:
    paths = [path for result in group for path in result.paths]
    return replace(group[0], paths=paths, curves=joined([result.curves for result in group]))


def pooling_text(results: Sequence[Result]) -> list[str]:
    """Return what is pooled, in a paragraph."""
    pools = [result for result in results if len(result.paths) > 1]
    if pools:
        texts = [f"{' and '.join(map(attrgetter('name'), pool.paths))} as {pool.name}" for pool in pools]
        return [f"From here on these are one, as runs of one experiment: {'; '.join(texts)}.", ""]
    free = ", ".join(NOT_IN_CHECKSUM)
    return [f"Nothing is pooled: no two runs have experiments equal but for {free}.", ""]
