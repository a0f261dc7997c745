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

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from statistics import fmean
from typing import Annotated, Final, Literal, TypeAlias

import matplotlib
import numpy as np
import pyarrow as pa
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from rich.table import Table

from cprl.evaluation.evaluate import (
    INTERVALS,
    SEED,
    check_same_game,
    fresh_episodes,
    how_they_play,
    opened,
    says_nothing,
    table_of,
    unit_of_rewards,
)
from cprl.evaluation.lanes import Fresh, Played, Source, pooled
from cprl.measuring.metrics import with_unit
from cprl.measuring.statistics import (
    Estimate,
    Measured,
    difference,
    institution_measures,
    over_replicas,
    social_measures,
)
from cprl.runs.episodes import labelled
from cprl.system.defaults import Diagonal
from cprl.terminal.style import EMPTY, SHADES, SMALL_PT, draw_cell, head, picture_path, save, wrapped
from cprl.training.agents import LoadedRun
from cprl.values import Range, checked

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
        """
        agents = list(self.by_agent)
        if agent is not None:
            agents = [checked("agent", agent, Annotated[int, Range(0, len(agents) - 1)])]
        returns = {f"{whose}/return": over_replicas(self.returns(whose, agents)) for whose in _WHOSE}
        apart = agents[:1] if self.is_self_play else agents
        played = pooled(self.by_agent[focal] for focal in apart)
        return {**returns, **social_measures(played), **institution_measures(played)}

    def returns(self, whose: Whose, agents: Sequence[int] = ()) -> dict[int, list[float]]:
        """A return by replica, of each episode with each focal agent.

        Args:
            whose: "focal", "background", the mean of the background agents, or "group", the sum of all.
        """
        values: dict[int, list[float]] = {}
        for agent in agents or self.by_agent:
            for replica, episodes in self.by_agent[agent].items():
                of_episodes = (float(_WHOSE[whose](episode.return_, agent)) for episode in episodes)
                values.setdefault(replica, []).extend(of_episodes)
        return values


@dataclass(frozen=True, kw_only=True, eq=False)
class CrossPlay:
    """The matrix of cross-play; see the docstring of this module."""

    runs: Mapping[str, LoadedRun]
    """The runs by name."""
    cells: Mapping[tuple[str, str], Cell]
    """The cells by the names of the focal agent's run and of the background agents' run."""
    fresh: Fresh
    diagonal: Diagonal

    def __repr__(self) -> str:
        return f"CrossPlay({', '.join(self.runs)}; {self.fresh}, seed={self.fresh.seed})"

    def cell(self, focal: str, background: str) -> Cell:
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
        diagonal: the pairing of a run with itself: "self", agents that were trained together, or
            "cross_seed", a focal agent of the run's next replica.
    """
    checked("diagonal", diagonal, Diagonal)
    named = named_runs(runs, allow)
    first, *_ = named.values()
    check_same_game(named)
    if first.game.agents == 1:
        raise ValueError("the game has 1 agent; allowed for cross-play: at least 2; use `cprl evaluate`")
    fresh = fresh_episodes(named.values(), episodes=episodes, greedy=greedy, seed=seed, replicas=replicas)
    numbers = fresh.replicas
    if diagonal == "cross_seed" and len(numbers) < 2:
        raise ValueError(f"the replicas are {list(numbers)}; allowed for cross_seed: at least 2")
    following = dict(zip(numbers, [*numbers[1:], numbers[0]], strict=True))
    cells = {}
    for focal, background in product(named, repeat=2):
        where, is_self_play = named[background], focal == background and diagonal == "self"
        themselves, agents = [Source(where)] * first.game.agents, range(first.game.agents)
        if is_self_play:
            by_agent = dict.fromkeys(agents, fresh.play(where, fresh.agents(themselves)))
        else:
            visitor = Source(named[focal], following if focal == background else None)
            by_agent = {
                agent: fresh.play(
                    where, fresh.agents([*themselves[:agent], visitor, *themselves[agent + 1 :]])
                )
                for agent in agents
            }
        cells[focal, background] = Cell(
            focal=focal, background=background, by_agent=by_agent, is_self_play=is_self_play
        )
    return CrossPlay(runs=named, cells=cells, fresh=fresh, diagonal=diagonal)


def named_runs(
    runs: Sequence[str | Path | LoadedRun] | Mapping[str, str | Path | LoadedRun],
    allow: Sequence[str],
    command: str = "crossplay",
) -> dict[str, LoadedRun]:
    """The runs by given names, by names of their directories, or by their paths if those coincide."""
    given: list[str] = []
    if isinstance(runs, Mapping):
        given, runs = list(runs), list(runs.values())
    opened_runs = [opened(run, allow) for run in runs]
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


@dataclass(frozen=True, kw_only=True)
class Gain:
    """Differences of returns from those of the same background agents among themselves, paired by replica: in
    cross-play from the diagonal cell."""

    focal: Estimate
    """Of the focal agent, from the agent of the background agents' run with the same index."""
    background: Estimate
    """Of the mean of the background agents, from the same agents among themselves."""

    @property
    def exploits(self) -> bool:
        """Whether the focal agent gains and the background agents lose, both by intervals without 0."""
        return self.focal.low > 0 and self.background.high < 0


def gains(played: CrossPlay) -> dict[tuple[str, str], Gain]:
    """The gains of all cells but the diagonal, by the names of the focal and of the background agents' run.

    Each number is first averaged over a replica's episodes and focal agents; replicas are paired, because
    both cells have the same background agents and worlds. With `diagonal="cross_seed"` the agent whose place
    is taken was not trained with the background agents either, so that a gain is due to the run alone.
    """
    means: dict[Whose, dict[tuple[str, str], list[float]]] = {
        whose: {at: _means(played, at, whose) for at in played.cells} for whose in ("focal", "background")
    }

    def gain(focal: str, background: str, whose: Whose) -> Estimate:
        reached, usual = means[whose][focal, background], means[whose][background, background]
        return difference(reached, usual, paired=True)

    return {
        (focal, background): Gain(
            focal=gain(focal, background, "focal"), background=gain(focal, background, "background")
        )
        for focal, background in played.cells
        if focal != background
    }


def diagonal_returns(played: CrossPlay) -> Mapping[str, float]:
    """The mean return of an agent in each diagonal cell, by the name of the run."""
    return {name: fmean(_means(played, (name, name), "focal")) for name in played.runs}


def _means(played: CrossPlay, at: tuple[str, str], whose: Whose) -> list[float]:
    returns = played.cell(*at).returns(whose)
    return [fmean(returns[replica]) for replica in played.fresh.replicas]


_COLOURS: Final = "RdBu"
_CELL_IN: Final = (0.82, 0.45)
_NARROWEST_IN: Final = 7.0
_PANELS: Final = {
    "focal": "the focal agent, beside the agent whose place it takes",
    "background": "the background agents, beside themselves without it",
}


def draw_gains(played: CrossPlay, path: Path | str) -> Path:
    """Draws `gains`, a row for each focal agent's run, a column for each of background agents."""
    path, by_cell = picture_path(path), gains(played)
    names, diagonal = list(played.runs), diagonal_returns(played)
    returns = with_unit("focal/return", rewards=unit_of_cells(played)).partition("/")[2]
    width = max(_CELL_IN[0] * len(names) + 2.6, _NARROWEST_IN)
    figure = Figure((width, 2 * (_CELL_IN[1] * len(names) + 0.9) + 1.2), layout="constrained")
    for axes, (whose, title) in zip(figure.subplots(2, 1), _PANELS.items(), strict=True):
        differences = {at: getattr(gain, whose) for at, gain in by_cell.items()}
        _draw_matrix(axes, names, differences, diagonal)
        axes.set_title(f"difference in {returns} of {title}", fontsize=SMALL_PT + 1)
    note = (
        f"{played.fresh} with focal agent at each index; diagonal ({played.diagonal.replace('_', '-')}): an "
        "agent's return. * the 95 % interval by Student's t excludes 0, as that of about one in twenty would "
        f"by chance; these are {2 * len(by_cell)}."
    )
    head(figure, "Cross-play: who gains among whom", note)
    return save(figure, path, colours=SHADES)


def _draw_matrix(
    axes: Axes,
    names: list[str],
    gains_by_cell: Mapping[tuple[str, str], Estimate],
    diagonal: Mapping[str, float],
) -> None:
    reach = max(abs(gain.value) for gain in gains_by_cell.values()) or 1.0
    scale, colours = Normalize(-reach, reach), matplotlib.colormaps[_COLOURS]
    for (focal, background), gain in gains_by_cell.items():
        star = " *" if gain.low > 0 or gain.high < 0 else ""
        at = names.index(background), names.index(focal)
        draw_cell(axes, *at, colours(scale(gain.value)), f"{gain.value:+.3g}{star}")
    for place, name in enumerate(names):
        draw_cell(axes, place, place, EMPTY, f"{diagonal[name]:.3g}")
    labels = [wrapped(name, _CELL_IN[0]) for name in names]
    axes.set_xticks(range(len(names)), labels)
    axes.set_yticks(range(len(names)), names)
    axes.set(xlim=(-0.5, len(names) - 0.5), ylim=(len(names) - 0.5, -0.5))
    axes.set_xlabel("background agents", fontsize=SMALL_PT)
    axes.set_ylabel("focal agent", fontsize=SMALL_PT)
    axes.tick_params(labelsize=SMALL_PT, length=0)
    axes.figure.colorbar(matplotlib.cm.ScalarMappable(scale, _COLOURS), ax=axes).ax.tick_params(
        labelsize=SMALL_PT
    )


def heading(played: CrossPlay) -> str:
    exploring = how_they_play(played.runs.values(), played.fresh)
    return (
        f"Cross-play: {played.fresh} with focal agent at each index, seed {played.fresh.seed}{exploring}, "
        f"diagonal: {played.diagonal}\n{INTERVALS}"
    )


def matrices(played: CrossPlay) -> Iterator[Table]:
    """A matrix for each metric: rows are the focal agent's run, columns the background agents' run."""
    cells = {at: cell.measures() for at, cell in played.cells.items()}
    rewards = unit_of_cells(played)
    for name in next(iter(cells.values())):
        of_name = [measured[name] for measured in cells.values()]
        if not (says_nothing(name, of_name) or _repeats(name, cells.values())):
            texts = {at: str(measured[name]) for at, measured in cells.items()}
            yield _matrix(with_unit(name, rewards=rewards), played, texts)


def _matrix(title: str, played: CrossPlay, texts: Mapping[tuple[str, str], str]) -> Table:
    """A text for each pair of runs, "" where there is none."""
    rows = [(focal, *(texts.get((focal, other), "") for other in played.runs)) for focal in played.runs]
    return table_of(title, ["focal \\ background", *played.runs], rows)


def gains_tables(played: CrossPlay) -> Iterator[Table]:
    """A matrix of what focal agents gain, and one of what background agents do; see `gains`."""
    by_cell, rewards = gains(played), unit_of_cells(played)
    for whose, beside in (("focal", "the agent whose place it takes"), ("background", "the diagonal")):
        title = with_unit(f"{whose}/return", rewards=rewards)
        yield _matrix(
            f"{title}, difference from {beside}, paired by replica [95 % interval by Student's t]",
            played,
            {at: str(getattr(gain, whose)) for at, gain in by_cell.items()},
        )


def agents_table(played: CrossPlay) -> Table:
    """The returns of each cell by the index of the focal agent."""
    names, rewards = ("focal/return", "background/return", "group/return"), unit_of_cells(played)
    headings = ["focal", "background", "focal agent", *(with_unit(name, rewards=rewards) for name in names)]
    rows = []
    for (focal, background), cell in played.cells.items():
        for agent in cell.by_agent:
            measured = cell.measures(agent)
            rows.append((focal, background, str(agent), *(str(measured[name]) for name in names)))
    return table_of("returns by the focal agent's index", headings, rows, texts=3)


def _repeats(name: str, cells: Iterable[Mapping[str, Measured]]) -> bool:
    """Whether group/return says the same: a reward is an apple but for what institutions take and give."""
    return name == "collective_return" and not any("institutions/fines" in cell for cell in cells)


def unit_of_cells(played: CrossPlay) -> str:
    return unit_of_rewards(next(iter(next(iter(played.cells.values())).by_agent.values())))
