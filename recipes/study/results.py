"""What a report needs of finished runs: their files, their measures, and random play of their games.

Result              the files of a run
Measures            of its training curves, and of its trained agents in new worlds
PooledResult        runs of one experiment under several seeds, as one result of all their replicas
returns_by_chance   random play over 10,000 episodes, which the study's random scores are compared with
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from phases import Phase, phases_of
from planner import harvests
from published import PublishedExperiment, published_experiment

from cprl import presets
from cprl.algorithms import DQN
from cprl.commons.game import Game
from cprl.envs.commons_env import CommonsEnv
from cprl.evaluation.lanes import Agent, agents_of, policies_of, scripted, worlds_of
from cprl.experiment import Experiment
from cprl.experimental.movement import Trace, overlap, trace
from cprl.measuring.statistics import estimate
from cprl.measuring.windows import SMOOTHED_EPISODES, running_mean
from cprl.population import Learning, Scripted, Team, exploration_steps
from cprl.runs.curves import as_curves, curves_of, episode_reached
from cprl.runs.episodes import read_episodes
from cprl.runs.files import read_json
from cprl.runs.recipe import read_recipe
from cprl.runs.weights import lacks_weights
from cprl.studies.study import UNNAMED, Condition
from cprl.system.defaults import SEED, Fresh
from cprl.training.stored import LoadedRun, load

Values = NDArray[np.float64]

PUBLISHED_GAMMA: Final = 0.995
"""The discount of the text; titles name others."""
TOO_FEW: Final = "too few episodes"
LAST: Final = 500
"""The episodes at the end of a training that stand for what was learned."""
WORLDS: Final = 64
"""The number of new worlds per replica in which trained agents play one episode each, as in evaluation."""
NEARNESS: Final = "steps to the nearest other when firing, over that in all steps"
OVERLAP: Final = "overlap of the cells that two agents visit"
ROUNDS: Final = "rounds about the centre per 1000 steps, agent {agent}"


@dataclass(frozen=True, kw_only=True, eq=False)
class Measures:
    """Measures of a run, float64 [R] each by name, for R replicas."""

    training: Mapping[str, Values]
    """Of its training curves."""
    trained: Mapping[str, Values]
    """Of its trained agents in new worlds; only those defined in all replicas; empty where the results were
    exported without weights."""
    random: Mapping[str, Values]
    """Of the random policy in the same worlds; likewise."""


def measures(run: Path, *, window: int = SMOOTHED_EPISODES, seed: int = SEED) -> Measures:
    """All measures of a run: of its training curves, and of its trained agents in new worlds.

    Args:
        run: The directory of the run, or of its exported results.
        window: The window of the running means of which some measures are, in episodes.
        seed: The seed of the new worlds.
    """
    training = of_training(curves_of(run), window=window)
    if lacks_weights(run):
        return Measures(training=training, trained={}, random={})
    loaded = load(run)
    fresh = Fresh(replicas=tuple(loaded.replicas), episodes=WORLDS, seed=seed, greedy=True)
    trained = _at_play(loaded, fresh, agents_of(loaded))
    return Measures(
        training=training,
        trained={name: values for name, values in trained.items() if np.isfinite(values).all()},
        random=_by_chance(loaded, fresh),
    )


_PLAYED_BY_CHANCE: Final[dict[Any, dict[str, Values]]] = {}


def _by_chance(run: LoadedRun, fresh: Fresh) -> dict[str, Values]:
    """`of_play` of the random policy; the same for all runs of a game, so played once."""
    key = run.game, run.experiment.transforms, fresh
    if key not in _PLAYED_BY_CHANCE:
        _PLAYED_BY_CHANCE[key] = _at_play(run, fresh, [scripted("random")] * run.game.agents)
    return _PLAYED_BY_CHANCE[key]


def _at_play(run: LoadedRun, fresh: Fresh, agents: Sequence[Agent]) -> dict[str, Values]:
    """`of_play` of a game in the same fresh worlds, whoever plays."""
    found: dict[str, list[Values]] = {}
    for group, env in worlds_of(fresh, run):
        played = trace(env, policies_of(fresh, run, agents, group))
        for name, values in of_play(played, len(group)).items():
            found.setdefault(name, []).append(values)
    return {name: np.concatenate(values) for name, values in found.items()}


def of_training(curves: dict[str, Values], *, window: int = SMOOTHED_EPISODES) -> dict[str, Values]:
    """Measures of training curves, float64 [R] each; without those of more episodes than there were.

    Args:
        curves: The curves of a run, as `curves_of` returns them.
        window: The window of the running means in episodes.
    """
    returns = running_mean(curves["collective_return"], window)
    episodes = curves["collective_return"].shape[1]
    has_last = episodes >= 500
    found = {"mean collective return over training": curves["collective_return"].mean(1)}
    if has_last:
        found |= {
            "collective return of the last 500 episodes": curves["collective_return"][:, -500:].mean(1),
            "survival in the last 500 episodes, steps": curves["survival_steps"][:, -500:].mean(1),
        }
    if episodes >= 600:
        dip = "depth of the deepest dip before episode 600, share of the peak before it"
        found[dip] = dip_depth(returns[:, :600])
    if episodes > window:
        found["episode of the highest collective return"] = returns.argmax(1).astype(np.float64)
    agents = [curves[f"return_{agent}"] for agent in range(_agents(curves))]
    if len(agents) > 1:
        for when, first in (*[("last 500 episodes", -500)] * has_last, ("whole training", 0)):
            means = np.stack([of_agent[:, first:].mean(1) for of_agent in agents])
            name = f"return of the poorest agent over that of the richest, {when}"
            found[name] = _share(means.min(0), means.max(0))
    return found


def with_interval(values: Values) -> str:
    """The mean of replicas, [R], with its 95 % interval by Student's t."""
    return f"{estimate(values):.4g}"


def dip_depth(curves: Values) -> Values:
    """The largest fall of each curve below its highest value so far, as a share of it, [R, E] to [R]."""
    deepest: Values = falls(curves).max(1)
    return deepest


def falls(curves: Values) -> Values:
    """How far each curve lies below its highest value so far, as a share of it, [R, E]."""
    peaks = np.maximum.accumulate(curves, axis=1)
    return _share(peaks - curves, peaks)


def of_play(played: Trace, replicas: int) -> dict[str, Values]:
    """Measures of played episodes, float64 [R] each; NaN where no agent fired while another was in play.

    Args:
        played: One episode of each world; the worlds of a replica are adjacent.
        replicas: The number of replicas R.
    """

    def by_replica(of_worlds: Values) -> Values:
        return of_worlds.reshape(replicas, -1)

    def mean(of_worlds: Values) -> Values:
        """The mean of each replica over those of its worlds in which the value is finite."""
        values = by_replica(of_worlds)
        with np.errstate(invalid="ignore"):
            means: Values = np.nansum(values, 1) / np.isfinite(values).sum(1)
        return means

    around = np.abs(rounds(played))
    agents = around.shape[1]
    found = {ROUNDS.format(agent=agent): mean(around[:, agent]) for agent in range(agents)}
    if agents > 1:
        fired, always = shooting_distance(played)
        shots, steps = played.fired.sum((0, 2)), played.played.sum(0)
        found |= {
            OVERLAP: mean(overlap(played)),
            NEARNESS: mean(fired) / mean(always),
            "shots per 1000 steps, all agents": 1000 * by_replica(shots).sum(1) / by_replica(steps).sum(1),
        }
        for agent in range(agents):
            near, usual = shooting_distance(played, agent=agent)
            found[f"{NEARNESS}, agent {agent}"] = mean(near) / mean(usual)
    return found


def rounds(trace: Trace) -> Values:
    """Rounds of each agent about the centre of the board per 1000 steps, clockwise positive, float64 [B, N].

    They are the changes of the agent's angle, as seen from the centre, summed over its steps.
    """
    height, width = trace.board
    down, right = trace.row - (height - 1) / 2, trace.col - (width - 1) / 2
    turned = np.diff(np.arctan2(down, right), axis=0)
    turned = (turned + np.pi) % (2 * np.pi) - np.pi
    here = trace.played[1:, :, None] & trace.in_play[1:] & trace.in_play[:-1]
    steps = np.maximum(here.sum(0), 1)
    gone: Values = (turned * here).sum(0) / (2 * np.pi) / steps * 1000
    return gone


def distance_to_nearest(trace: Trace) -> Values:
    """The distance from each agent to the nearest other agent in play, in steps: rows plus columns.

    Returns:
        float64 [T, B, N]; NaN where the agent, or every other agent, is out of play.
    """
    apart = np.abs(trace.row[..., :, None] - trace.row[..., None, :]) + np.abs(
        trace.col[..., :, None] - trace.col[..., None, :]
    ).astype(np.float64)
    both = trace.in_play[..., :, None] & trace.in_play[..., None, :]
    both &= ~np.eye(trace.row.shape[-1], dtype=bool)
    nearest: Values = np.where(both, apart, np.inf).min(-1)
    nearest[~np.isfinite(nearest)] = np.nan
    return nearest


def shooting_distance(trace: Trace, *, agent: int | None = None) -> tuple[Values, Values]:
    """The mean distance to the nearest other agent when an agent fires, and in all steps, float64 [B] each.

    NaN where no agent fired while another was in play.

    Args:
        trace: the played episodes.
        agent: the index of the agent whose distances are counted; None for all agents.
    """
    nearest = distance_to_nearest(trace)
    counted = np.isfinite(nearest) & trace.played[..., None]
    if agent is not None:
        counted &= np.arange(nearest.shape[-1]) == agent

    def mean_of(which: Values) -> Values:
        number = which.sum((0, 2))
        with np.errstate(invalid="ignore"):
            means: Values = np.where(which, nearest, 0.0).sum((0, 2)) / number
        return means

    return mean_of(counted & trace.fired), mean_of(counted)


def _share(part: Values, whole: Values) -> Values:
    shares: Values = np.divide(part, whole, out=np.zeros_like(whole), where=whole > 0)
    return shares


def _agents(curves: dict[str, Values]) -> int:
    return sum(name.startswith("return_") for name in curves)


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
        ended = self.curves["survival_steps"].cumsum(1)  # in one world episodes follow each other
        return None if ends is None else episode_reached(ended, ends)

    @cached_property
    def measures(self) -> Measures:
        """Measures of its training, and of its agents in new worlds."""
        return measures(self.path, window=self.window)

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
    def phases(self) -> list[Phase] | None:
        """Its phases; None if there are too few episodes, see `phases_of`."""
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


def read_result(path: Path) -> Result:
    """Reads a run's directory, or its exported results.

    Args:
        path: The directory.

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
    experiment = Experiment.from_recipe(recipe, directory=path)
    return Result(
        path=path,
        recipe=recipe,
        experiment=experiment,
        report=read_json(path / "report.json"),
        curves=curves,
        study=study_of(recipe["recipe"], experiment),
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


_LONGEST_NAME: Final = 80
"""Of a pool; figures are named after it."""


@dataclass(kw_only=True, eq=False)
class PooledResult(Result):
    """Several runs of one experiment; what they are is told by the first."""

    parts: Sequence[Result]

    @property
    def name(self) -> str:
        """The names of the runs' directories, or that of the first and the number of others."""
        first, *others = (part.name for part in self.parts)
        whole = "+".join([first, *others])
        return whole if len(whole) <= _LONGEST_NAME else f"{first}+{len(others)} more"

    @cached_property
    def measures(self) -> Measures:
        """Measures of all trainings, and of agents at play where all runs have weights: each run's in worlds
        of its own, so that replicas are independent."""
        if any(lacks_weights(part.path) for part in self.parts):
            training = of_training(dict(self.curves), window=self.window)
            return Measures(training=training, trained={}, random={})
        each = [
            measures(part.path, window=self.window, seed=SEED + nth) for nth, part in enumerate(self.parts)
        ]
        return Measures(
            training=_joined([own.training for own in each]),
            trained=_joined([own.trained for own in each]),
            random=_joined([own.random for own in each]),
        )

    def of_agents(self, column: str) -> Values | None:
        each = [part.of_agents(column) for part in self.parts]
        known = [own for own in each if own is not None]
        return np.concatenate(known) if len(known) == len(each) else None

    def evaluated(self, policy: str) -> Mapping[str, Values] | None:
        each = [part.evaluated(policy) for part in self.parts]
        known = [own for own in each if own is not None]
        return _joined(known) if len(known) == len(each) else None


def pooled(results: Sequence[Result]) -> list[Result]:
    """Results of which those of one experiment are one, in the place of the first; others as they are.

    An experiment is one whatever its runs are called, but what repeats an experiment of the study is pooled
    only with what repeats it, too.

    Raises:
        ValueError: for two runs of one experiment with the same seed, whose replicas are the same.
    """
    groups: dict[tuple[str, int | None], list[Result]] = {}
    for result in results:
        number = None if result.study is None else result.study.number
        group = groups.setdefault((Condition(result.experiment).checksum, number), [])
        same = [other.path for other in group if other.experiment.seed == result.experiment.seed]
        if same:
            raise ValueError(
                f"runs has {same[0]} and {result.path}, of one experiment and both of seed "
                f"{result.experiment.seed}, which have the same replicas; allowed in a pool: each seed once"
            )
        group.append(result)
    return [group[0] if len(group) == 1 else _of(group) for group in groups.values()]


def _of(parts: Sequence[Result]) -> PooledResult:
    first = parts[0]
    return PooledResult(
        path=first.path,
        recipe=first.recipe,
        experiment=first.experiment,
        report=first.report,
        curves=_joined([part.curves for part in parts]),
        study=first.study,
        parts=parts,
    )


def told(results: Sequence[Result]) -> list[str]:
    """What is pooled, in a paragraph."""
    pools = [
        f"{' and '.join(part.name for part in own.parts)} as {own.name}"
        for own in results
        if isinstance(own, PooledResult)
    ]
    if pools:
        return [f"From here on these are one, as runs of one experiment: {'; '.join(pools)}.", ""]
    return [f"Nothing is pooled: no two runs have experiments equal but for {', '.join(UNNAMED)}.", ""]


def _joined(tables: Sequence[Mapping[str, Values]]) -> dict[str, Values]:
    """The names that all tables have, with the replicas of all."""
    names = [name for name in tables[0] if all(name in own for own in tables)]
    return {name: np.concatenate([own[name] for own in tables]) for name in names}


EPISODES: Final = 10_000
"""Of random play."""
AT_ONCE: Final = 2_500
"""Worlds of random play at once."""
PUBLISHED_EPISODES: Final = 100
"""The episodes of the study's random score: its programs of random play, test_random.py, play so many."""


@cache
def returns_by_chance(game: Game, *, episodes: int = EPISODES) -> Values:
    """The collective harvest of each of so many episodes in which all agents act at random, float64
    [episodes].

    The same for the same game, and played once. Episode e is played in world e; its actions are drawn for all
    worlds played at once.

    Args:
        game: a game without institutions, since these are paid for actions.
        episodes: the number of episodes.
    """
    return np.concatenate(
        [_played(game, first, min(AT_ONCE, episodes - first)) for first in range(0, episodes, AT_ONCE)]
    )


def _played(game: Game, first: int, worlds: int) -> Values:
    """An episode in each of these worlds."""
    rng = np.random.default_rng([SEED, first])
    size = worlds, game.agents
    env = CommonsEnv(game, worlds, seed=SEED, first_world=first)
    return harvests(env, lambda _: rng.integers(len(game.actions), size=size))


_BAR: Final = "\\|"
"""What stands for a bar that does not end a cell."""


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """The lines of a table, followed by an empty line; a bar in a cell is escaped."""
    lines = [head, ["---"] * len(head), *rows]
    return [f"| {' | '.join(cell.replace('|', _BAR) for cell in cells)} |" for cells in lines] + [""]
