"""Result: the files of a finished run that a report needs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from cprl import presets
from cprl.algorithms import DQN
from cprl.commons.game import Game
from cprl.experiment import Experiment
from cprl.measuring.published import SMOOTHED_EPISODES, PublishedExperiment, published_experiment
from cprl.population import Learning, Scripted, Team, exploration_steps
from cprl.reporting.measures import Measures, measures
from cprl.runs.curves import Phases, as_curves, curves_of, episode_of_step, phases_of, running_mean
from cprl.runs.episodes import read_episodes
from cprl.runs.files import read_json
from cprl.runs.recipe import read_recipe

Values = NDArray[np.float64]

PUBLISHED_GAMMA: Final = 0.995
"""The discount of the text; titles name others."""
TOO_FEW: Final = "too few episodes"


@dataclass(kw_only=True, eq=False)
class Result:
    """The files of a finished run that a report needs, as read."""

    path: Path
    recipe: Mapping[str, Any]
    experiment: Experiment
    report: Mapping[str, Any]
    """`report.json`."""
    curves: Mapping[str, Values]
    study: PublishedExperiment | None
    """The study's experiment that it repeats, see `study_of`."""
    allow: Sequence[str] = ()
    """The user's own code, "module:Class", that the run may import."""

    @property
    def name(self) -> str:
        """The name of the run's directory."""
        return self.path.name

    @property
    def title(self) -> str:
        """What was run, in a few words."""
        replicas, episodes = self.curves["collective_return"].shape
        parts = [self.recipe["recipe"]]
        if self.variant is not None:
            parts.append(f"{self.variant} rules")
        specs = [spec for spec in self.experiment.agents if isinstance(spec, Learning)]
        algorithm = specs[0].algorithm if specs else None
        settings = algorithm.settings if isinstance(algorithm, DQN) else None
        if settings is not None:
            parts.append(f"targets replaced every {settings.target_every_episodes} episodes")
            parts.append(f"epsilon decays in {settings.epsilon_decay_steps:,} steps")
            if settings.gamma != PUBLISHED_GAMMA:
                parts.append(f"gamma {settings.gamma:g}")
            if settings.optimizer != "adam":
                parts.append(settings.optimizer)
            if isinstance(algorithm, DQN) and algorithm.loss_function != "l2":
                parts.append(algorithm.loss_function)
        return ", ".join([*parts, f"{replicas} replicas of {episodes:,} episodes"])

    @property
    def learns(self) -> bool:
        """Whether any of its agents learns."""
        return any(isinstance(spec, Learning | Team) for spec in self.experiment.agents)

    @property
    def variant(self) -> str | None:
        """The variant of the study's rules that its game has; None for others."""
        return presets.variant_of(self.experiment.game)

    @property
    def random_game(self) -> Game | None:
        """The game of which the study gives a random score; None if it gives none, or the game has rules that
        random play is not played with."""
        game, study = self.experiment.game, self.study
        scored = study is not None and study.random is not None
        return game if scored and isinstance(game, Game) and not game.institutions else None

    @property
    def is_whole(self) -> bool:
        """Whether it has as many episodes as the study's experiment, or more."""
        return self.study is not None and self.curves["collective_return"].shape[1] >= self.study.episodes

    def over_training(self, metric: str) -> Values:
        """The mean of a metric over the training of each replica, [R]; of a longer training than the study's,
        over as many episodes as that has."""
        means: Values = self.curves[metric][:, : self.study.episodes if self.study else None].mean(1)
        return means

    @property
    def window(self) -> int:
        """The window of its running means in episodes: that of the published curves, if there are any."""
        return self.study.window_episodes if self.study else SMOOTHED_EPISODES

    @property
    def exploration_ends(self) -> float | None:
        """The episode in which the last epsilon reaches its end, the mean of replicas; None if none does."""
        ends = exploration_steps(self.experiment.agents)
        return None if ends is None else episode_of_step(dict(self.curves), ends)

    @cached_property
    def measures(self) -> Measures:
        """Measures of its training, and of its agents in new worlds."""
        return measures(self.path, window=self.window, allow=self.allow)

    def of_agents(self, column: str) -> Values | None:
        """A column of the table of episodes for each agent, float64 [R, E, N]; None if there is no such
        column."""
        table = self._table
        if column not in table.column_names:
            return None
        replicas, episodes = self.curves["survival_steps"].shape
        replica, episode, agent = (table[name].to_numpy() for name in ("replica", "episode", "agent"))
        row = np.unique(replica, return_inverse=True)[1]
        found = np.full((replicas, episodes, int(agent.max()) + 1), np.nan)
        kept = episode < episodes
        values = table[column].to_numpy(zero_copy_only=False).astype(np.float64)
        found[row[kept], episode[kept], agent[kept]] = values[kept]
        return found

    @cached_property
    def _table(self) -> pa.Table:
        return read_episodes(self.path)

    @cached_property
    def phases(self) -> Phases | None:
        """Change points and phases; None if there are too few episodes, see `phases_of`."""
        return phases_of(dict(self.curves))

    def evaluated(self, policy: str) -> Mapping[str, Values] | None:
        """The mean of each metric and replica in its evaluation, [R] by name; None if there is none.

        Args:
            policy: "random" or "trained".
        """
        path = self.path / "evaluation" / f"{policy}.parquet"
        if not path.exists():
            return None
        curves = as_curves(pq.read_table(path))
        return {name: running_mean(values, values.shape[1])[:, 0] for name, values in curves.items()}


def read_result(path: Path, *, allow: Sequence[str] = ()) -> Result:
    """Reads a run's directory, or its exported results.

    Args:
        path: The directory.
        allow: See `cprl.load`.

    Raises:
        ValueError: If the path has no run, or one of a game without harvest; for code that is not allowed.
        FileNotFoundError: If the run has no episodes or has not ended.
    """
    recipe, curves = read_recipe(path), curves_of(path)
    if "collective_return" not in curves:
        raise ValueError(
            f"{path} plays a game that reports no harvest; allowed in a report beside the published study: a "
            "commons; evaluate_run and crossplay measure the returns of others"
        )
    experiment = Experiment.from_recipe(recipe, allow=allow, directory=path)
    return Result(
        path=path,
        recipe=recipe,
        experiment=experiment,
        report=read_json(path / "report.json"),
        curves=curves,
        study=study_of(recipe["recipe"], experiment),
        allow=allow,
    )


def study_of(recipe: str, experiment: Experiment) -> PublishedExperiment | None:
    """The study's experiment that a run repeats: by the name of its recipe, if it plays on the study's map,
    which has the number of agents, whatever the rules; or since it plays a variant of the study's game, beam
    included, with as many agents that learn by DQN, whatever their settings; None for others."""
    game, specs = experiment.game, experiment.agents
    named = published_experiment(recipe)
    if named is not None and isinstance(game, Game) and game.map == presets.game(named.board).map:
        return named
    if not isinstance(game, Game) or presets.variant_of(game) is None:
        return None
    if game.agents > 1 and not game.rules.may_fire:
        return None
    learns = [isinstance(spec, Learning) and isinstance(spec.algorithm, DQN) for spec in specs]
    against_random = learns == [True, False] and specs[1] == Scripted("random")
    if not (all(learns) or against_random):
        return None
    boards = {presets.game(board).map: board for board in presets.BOARDS}
    return published_experiment("two_against_random" if against_random else boards[game.map])
