"""crossplay: a focal agent of one stored run plays with background agents of another.

In cell (i, j) of the matrix the focal agent, with index s, is from run i, and all others, the background
agents, are from run j. Each cell is played for every index s and every replica r, with replica r of both
runs, in the same worlds for all cells and indices. A number of a cell is the mean over focal agents,
estimated over replicas, because only replicas are independent.

The diagonal is self-play: the focal agent was trained with the background agents, in the same replica. In all
other cells it is from another run and was not trained with them. diagonal="cross_seed" separates the two
effects: the focal agent of the diagonal is then from the run's next replica, trained in the same way but not
with the background agents.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import product
from pathlib import Path
from typing import Final, Literal, TypeAlias, get_args

import numpy as np
import pyarrow as pa

from cprl import arguments
from cprl.arguments import Diagonal
from cprl.evaluation.evaluate import SEED, check, chosen_replicas, opened
from cprl.evaluation.lanes import Played, Source, play, policies_of, pooled
from cprl.evaluation.same_game import check_same_game
from cprl.measuring.replicas import Measured, institution_measures, over_replicas, social_measures
from cprl.runs.labelled import labelled
from cprl.stored import LoadedRun

Whose: TypeAlias = Literal["focal", "background", "group"]
_WHOSE: Final[dict[Whose, Callable[..., float]]] = {
    "focal": lambda returns, at: returns[at],
    "background": lambda returns, at: np.delete(returns, at).mean(),
    "group": lambda returns, at: returns.sum(),
}
"""Of the agents' returns, float64 [N], and the focal agent's index."""

SELF_PLAY: Final = -1
"""The focal agent of self-play in tables: every agent is focal and background."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Cell:
    """The episodes of focal agents of one run with background agents of another."""

    focal: str
    background: str
    by_agent: Mapping[int, Played] = field(repr=False)
    """The episodes by the index of the focal agent; in self-play the same episodes for each."""
    is_self_play: bool

    def measures(self, agent: int | None = None) -> dict[str, Measured]:
        """focal/return, background/return (the mean of the background agents), group/return, the social
        metrics, and those of institutions as `institutions/fines` and so on.

        Args:
            agent: the index of the focal agent; None for the mean over all indices.

        Raises:
            ValueError: if there is no such agent.
        """
        agents = list(self.by_agent)
        if agent is not None:
            agents = [arguments.integer("agent", agent, 0, len(agents) - 1)]
        returns = {f"{whose}/return": over_replicas(self.returns(whose, agents)) for whose in _WHOSE}
        apart = agents[:1] if self.is_self_play else agents
        played = pooled(self.by_agent[focal] for focal in apart)
        return {**returns, **social_measures(played), **institution_measures(played)}

    def returns(self, whose: Whose, agents: Sequence[int] = ()) -> dict[int, list[float]]:
        """A return by replica, of each episode with each focal agent.

        Args:
            whose: "focal", "background", the mean of the background agents, or "group", the sum of all.
            agents: the indices of focal agents; empty for all.

        Raises:
            ValueError: if `whose` is another word.
        """
        arguments.choice("whose", whose, _WHOSE)
        values: dict[int, list[float]] = {}
        for agent in agents or self.by_agent:
            for replica, episodes in self.by_agent[agent].items():
                own = (float(_WHOSE[whose](one.return_, agent)) for one in episodes)
                values.setdefault(replica, []).extend(own)
        return values


@dataclass(frozen=True, kw_only=True, eq=False)
class CrossPlay:
    """The matrix of cross-play; see the docstring of this module."""

    runs: Mapping[str, LoadedRun]
    """The runs by name."""
    cells: Mapping[tuple[str, str], Cell]
    """The cells by the names of the focal agent's run and of the background agents' run."""
    replicas: list[int]
    episodes: int
    seed: int
    greedy: bool
    diagonal: Diagonal

    def __repr__(self) -> str:
        names = ", ".join(self.runs)
        return f"CrossPlay({names}; replicas {self.replicas}, {self.episodes} episodes, seed={self.seed})"

    def cell(self, focal: str, background: str) -> Cell:
        """The cell of two runs, by their names.

        Raises:
            ValueError: if a name is unknown.
        """
        if (focal, background) not in self.cells:
            raise ValueError(f"the cell is {(focal, background)}; allowed: two of the runs {list(self.runs)}")
        return self.cells[focal, background]

    def table(self) -> pa.Table:
        """All episodes with the columns of `episodes.parquet`, after "focal" and "background", the names of
        runs, and "focal_agent", -1 in self-play. "replica" is that of the background agents."""
        return labelled(
            (
                {
                    "focal": cell.focal,
                    "background": cell.background,
                    "focal_agent": SELF_PLAY if cell.is_self_play else agent,
                },
                replica,
                episodes,
            )
            for cell in self.cells.values()
            for agent, played in list(cell.by_agent.items())[: 1 if cell.is_self_play else None]
            for replica, episodes in played.items()
        )


def crossplay(
    runs: Sequence[str | Path | LoadedRun] | Mapping[str, str | Path | LoadedRun],
    *,
    episodes: int = 20,
    greedy: bool = False,
    seed: int = SEED,
    replicas: Sequence[int] = (),
    diagonal: Diagonal = "self",
    allow: Sequence[str] = (),
) -> CrossPlay:
    """Plays agents of each run with agents of each other run, one focal agent at a time.

    Args:
        runs: at least two runs of the same game: directories, exported results, or values of `cprl.load`;
            or a table of them by the names that they get, which are otherwise those of their directories.
        episodes: episodes of each replica with each focal agent, each in its own world.
        greedy: see `cprl.evaluate_run`.
        seed: the seed of the worlds and of all random numbers.
        replicas: the indices of the replicas that play; by default all that every run has.
        diagonal: the pairing of a run with itself: "self", agents that were trained together, or
            "cross_seed", a focal agent of the run's next replica.
        allow: see `cprl.load`.

    Raises:
        ValueError: if the runs have different games (names the differences), the game has one agent, a run is
            given twice, `diagonal` is another word, or "cross_seed" has a single replica; and see
            `cprl.evaluate_run`.
    """
    arguments.choice("diagonal", diagonal, get_args(Diagonal))
    named = named_runs(runs, allow)
    first, *_ = named.values()
    check_same_game(named)
    if first.game.agents == 1:
        raise ValueError("the game has 1 agent; allowed for cross-play: at least 2; use `cprl evaluate`")
    check(episodes=episodes, seed=seed, greedy=greedy, runs=list(named.values()))
    numbers = chosen_replicas(named, replicas)
    if diagonal == "cross_seed" and len(numbers) < 2:
        raise ValueError(f"the replicas are {numbers}; allowed for cross_seed: at least 2")
    following = dict(zip(numbers, [*numbers[1:], numbers[0]], strict=True))
    among = partial(_played_among, replicas=numbers, episodes=episodes, seed=seed, explore=not greedy)
    cells = {}
    for focal, background in product(named, repeat=2):
        is_self_play = focal == background and diagonal == "self"
        of_replicas = following if focal == background and not is_self_play else None
        focal_source = None if is_self_play else Source(named[focal], of_replicas)
        cells[focal, background] = Cell(
            focal=focal,
            background=background,
            by_agent=among(focal_source, named[background]),
            is_self_play=is_self_play,
        )
    return CrossPlay(
        runs=named,
        cells=cells,
        replicas=numbers,
        episodes=episodes,
        seed=seed,
        greedy=greedy,
        diagonal=diagonal,
    )


def _played_among(
    focal_source: Source | None,
    background: LoadedRun,
    *,
    replicas: Sequence[int],
    episodes: int,
    seed: int,
    explore: bool,
) -> dict[int, Played]:
    """The episodes by the focal agent's index; without focal agents, self-play runs once for all indices."""

    def played(sources: Sequence[Source]) -> Played:
        who = partial(policies_of, sources, worlds=episodes, seed=seed)
        return play(background, who, replicas, episodes=episodes, seed=seed, explore=explore)

    agents = range(background.game.agents)
    own = [Source(background)] * len(agents)
    if focal_source is None:
        return dict.fromkeys(agents, played(own))
    return {agent: played([*own[:agent], focal_source, *own[agent + 1 :]]) for agent in agents}


def named_runs(
    runs: Sequence[str | Path | LoadedRun] | Mapping[str, str | Path | LoadedRun],
    allow: Sequence[str],
    command: str = "crossplay",
) -> dict[str, LoadedRun]:
    """The runs by given names, by names of their directories, or by their paths if those coincide.

    Args:
        runs: see `crossplay`.
        allow: see `cprl.load`.
        command: what a message says that takes them.

    Raises:
        ValueError: for fewer than two, and for a run that is given twice.
    """
    given: list[str] = []
    if isinstance(runs, Mapping):
        for name in runs:
            arguments.object_of("a name of a run", name, str, "a text")
        given, runs = list(runs), list(runs.values())
    listed = arguments.listed("runs", runs, "a sequence of at least two runs")
    opened_runs = [opened(run, allow) for run in listed]
    if len(opened_runs) < 2:
        raise ValueError(
            f"the number of runs is {len(opened_runs)}; allowed: at least two: cprl {command} RUN RUN..."
        )
    paths = [run.path.resolve() for run in opened_runs]
    for place, path in enumerate(paths):
        if path in paths[:place]:
            raise ValueError(f"{opened_runs[place].path} is given twice; allowed: different runs")
    names = given or [path.name for path in paths]
    if len(set(names)) < len(names):
        names = [str(path) for path in paths]
    return dict(zip(names, opened_runs, strict=True))
