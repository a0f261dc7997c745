"""crossplay: a focal agent of one stored run plays with background agents of another.

In cell (i, j) of the matrix the focal agent, with index s, is from run i, and all others, the background
agents, are from run j. Each cell is played for every index s and every replica r of both runs, in the same
worlds. A number of a cell is the mean over focal agents, estimated over replicas.

The diagonal is self-play: the focal agent was trained with the background agents, in the same replica. In all
other cells it is from another run and was not trained with them. diagonal="cross_seed" separates the two
effects: the focal agent of the diagonal is then from the run's next replica, trained in the same way but not
with the background agents.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Final, NamedTuple

import matplotlib
from matplotlib.axes import Axes
from matplotlib.colors import Normalize

from cprl.evaluation.evaluate import (
    SEED,
    heading,
    opened,
    refuse_other_games,
    says_nothing,
    unit_of_rewards,
)
from cprl.evaluation.lanes import Part, Played, Results, Whose, agents_of, fresh_of, more
from cprl.measuring.played import Measured, notes_on
from cprl.measuring.registry import with_unit
from cprl.measuring.statistics import HOLM, Estimate, starred
from cprl.system.defaults import Diagonal
from cprl.system.working import say_how_far, working
from cprl.terminal import style
from cprl.terminal.tables import Cells
from cprl.training.agents import LoadedRun
from cprl.values import checked, refusal

SELF_PLAY: Final = -1
"""The focal agent of self-play in tables: every agent is focal and background."""

Runs = Sequence[str | Path | LoadedRun] | Mapping[str, str | Path | LoadedRun]
Pair = tuple[str, str]
"""The names of the focal agent's run and of the background agents' run."""


class Cell(Results):
    """The episodes of focal agents of one run with background agents of another."""

    @property
    def by_agent(self) -> dict[int, Played]:
        """The episodes by the index of the focal agent; in self-play the same episodes for each."""
        return {agent: part.played for part in self.parts for (agent,) in part.focal}

    def measures(self, agent: int | None = None) -> dict[str, Measured]:
        """focal/return, background/return (the mean of the background agents), group/return, the social
        metrics, and those of institutions as `institutions/fines` and so on.

        Args:
            agent: the index of the focal agent; None for all of them.
        """
        parts = self.parts
        if agent is not None:
            parts = [part._replace(focal=((agent,),)) for part in parts if (agent,) in part.focal]
            if not parts:
                raise refusal("agent", agent, f"one of {list(self.by_agent)}")
        return replace(self, parts=parts).estimates("focal", "background", "group")


@dataclass(frozen=True, kw_only=True, eq=False)
class CrossPlay(Results):
    """The matrix of cross-play, by "focal" and "background", the names of runs, and "focal_agent", -1 in
    self-play; the replica is that of the background agents. See the docstring of this module."""

    runs: Mapping[str, LoadedRun]
    """The runs by name."""
    diagonal: Diagonal

    def __repr__(self) -> str:
        return f"CrossPlay({', '.join(self.runs)}; {self.fresh}, seed={self.fresh.seed})"

    @property
    def cells(self) -> dict[Pair, Cell]:
        return {(focal, other): self.cell(focal, other) for focal in self.runs for other in self.runs}

    def cell(self, focal: str, background: str) -> Cell:
        parts = self.where(focal=focal, background=background).parts
        if not parts:
            raise refusal("the cell", (focal, background), f"two of the runs {list(self.runs)}")
        return Cell(parts=parts, fresh=self.fresh)


@working("playing each other")
def crossplay(
    runs: Runs,
    *,
    episodes: int = 20,
    greedy: bool = False,
    seed: int = SEED,
    replicas: Sequence[int] = (),
    diagonal: Diagonal = "self",
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
    named = named_runs(runs)
    fresh = fresh_of(named.values(), episodes=episodes, greedy=greedy, seed=seed, replicas=replicas)
    numbers = fresh.replicas
    if diagonal == "cross_seed" and len(numbers) < 2:
        raise ValueError(f"the replicas are {list(numbers)}; allowed for cross_seed: at least 2")
    following = dict(zip(numbers, (*numbers[1:], numbers[0]), strict=True))
    play = partial(fresh.play, among=named.values())
    parts: list[Part] = []
    for focal, background in product(named, repeat=2):
        where, labels = named[background], {"focal": focal, "background": background}
        home = agents_of(where)
        say_how_far(len(parts), None, "populations")
        if focal == background and diagonal == "self":
            each = tuple((agent,) for agent in range(len(home)))
            parts.append(Part({**labels, "focal_agent": SELF_PLAY}, play(where, home), each))
            continue
        for agent, visitor in enumerate(agents_of(named[focal], following if focal == background else None)):
            mixed = [*home[:agent], visitor, *home[agent + 1 :]]
            parts.append(Part({**labels, "focal_agent": agent}, play(where, mixed), ((agent,),)))
    return CrossPlay(runs=named, parts=parts, fresh=fresh, diagonal=diagonal)


def named_runs(runs: Runs) -> dict[str, LoadedRun]:
    """Runs of the same game of several agents by given names, by names of their directories, or by their
    paths if those coincide."""
    names: list[str] = []
    if isinstance(runs, Mapping):
        names, runs = list(runs), list(runs.values())
    loaded = [opened(run) for run in runs]
    if len(loaded) < 2:
        raise refusal("the number of runs", len(loaded), "at least two")
    paths = [run.path.resolve() for run in loaded]
    for path in paths:
        if paths.count(path) > 1:
            raise ValueError(f"{path} is given twice; allowed: different runs")
    names = names or [path.name for path in paths]
    if len(set(names)) < len(names):
        names = list(map(str, paths))
    named = dict(zip(names, loaded, strict=True))
    refuse_other_games(named)
    if loaded[0].game.agents == 1:
        raise ValueError("the game has 1 agent; allowed: at least 2; use `cprl evaluate`")
    return named


class Gain(NamedTuple):
    """Differences of returns from those of the same background agents among themselves, paired by replica: in
    cross-play from the diagonal cell."""

    focal: Estimate
    """Of the focal agent, from the agent of the background agents' run with the same index."""
    background: Estimate
    """Of the mean of the background agents, from the same agents among themselves."""


def gains(played: CrossPlay) -> dict[Pair, Gain]:
    """The gains of all cells but the diagonal.

    Each number is first averaged over a replica's episodes and focal agents; replicas are paired, because
    both cells have the same background agents and worlds. With `diagonal="cross_seed"` the agent whose place
    is taken was not trained with the background agents either, so that a gain is due to the run alone.
    """
    cells = played.cells
    return {
        (focal, background): gain_over(cell, cells[background, background])
        for (focal, background), cell in cells.items()
        if focal != background
    }


def gain_over(reached: Results, usual: Results) -> Gain:
    return Gain(focal=more(reached, usual, "focal"), background=more(reached, usual, "background"))


_BESIDE: Final[Mapping[Whose, str]] = {
    "focal": "the focal agent, beside the agent whose place it takes",
    "background": "the background agents, beside themselves without it",
}


def _texts(by_cell: Mapping[Pair, Gain], form: str = "") -> dict[Whose, dict[Pair, str]]:
    """The texts of all gains, with a star where one is not 0 among all of them."""
    both = starred([difference for gain in by_cell.values() for difference in gain], form)
    return {whose: dict(zip(by_cell, both[at::2], strict=True)) for at, whose in enumerate(_BESIDE)}


_COLOURS: Final = "RdBu"
_CELL: Final = (4.4, 3.0)
"""How wide and high cells are that have room for their numbers, in em."""


def draw_gains(played: CrossPlay, path: Path | str, *, width: style.Width = "page") -> Path:
    """Draws `gains`, a row for each focal agent's run, a column for each of background agents; a star where
    one is not 0 by Holm's method for all that are drawn. Cells that are too small for their numbers have the
    star alone."""
    by_cell, names, unit = gains(played), list(played.runs), unit_of_rewards(played)
    texts = _texts(by_cell, "+.3g")
    at_home = {(name, name): f"{played.cell(name, name).mean_returns('focal').mean():.3g}" for name in names}
    with style.drawing(path, width=width, colours=style.SHADES) as sheet:
        panels = sheet.panels(2, high=matrix_height(names))
        for axes, (whose, beside) in zip(panels, _BESIDE.items(), strict=True):
            differences = {pair: getattr(gain, whose).value for pair, gain in by_cell.items()}
            draw_matrix(sheet, axes, names, differences, texts[whose] | at_home)
            axes.set(xlabel="background agents", ylabel="focal agent")
            axes.set_title(beside)
        sheet.title = "Cross-play: who gains among whom"
        sheet.caption = (
            f"Difference in return{f', {unit}' if unit else ''}; {played.fresh} with focal agent at each "
            f"index; diagonal ({played.diagonal.replace('_', '-')}): an agent's return. {HOLM} for these "
            f"{2 * len(by_cell)}."
        )
    return Path(path)


def matrix_height(names: Sequence[str]) -> float:
    """Of a panel with a matrix, in em."""
    return max(_CELL[1] * len(names), 12) + 8


def draw_matrix(
    sheet: style.Sheet,
    axes: Axes,
    names: Sequence[str],
    values: Mapping[Pair, float],
    texts: Mapping[Pair, str],
    *,
    share: float = 1.0,
) -> None:
    """A matrix of differences in colours about 0; cells without a value are empty but for their text.

    Args:
        share: of the width of the sheet, which the panel has.
    """
    reach = max(map(abs, values.values())) or 1.0
    scale, colours = Normalize(-reach, reach), matplotlib.colormaps[_COLOURS]
    rows = [style.wrapped(name, 0.25 * share * sheet.width_em) for name in names]
    longest = style.CHARACTER * max(len(line) for name in rows for line in name.splitlines())
    wide = (0.8 * share * sheet.width_em - longest - 2) / len(names)
    for (row, column), text in texts.items():
        value = values.get((row, column))
        colour = style.EMPTY if value is None else colours(scale(value))
        text = text if wide >= _CELL[0] else "*" * text.endswith("*")
        style.draw_cell(axes, names.index(column), names.index(row), colour, text)
    is_narrow = wide < min(longest, 6)
    columns = names if is_narrow else [style.wrapped(name, wide) for name in names]
    axes.set_xticks(range(len(names)), columns, rotation=90 if is_narrow else 0)
    axes.set_yticks(range(len(names)), rows)
    axes.set(xlim=(-0.5, len(names) - 0.5), ylim=(len(names) - 0.5, -0.5))
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    sheet.figure.colorbar(matplotlib.cm.ScalarMappable(scale, _COLOURS), ax=axes)


def crossplay_heading(played: CrossPlay) -> str:
    each = " with focal agent at each index"
    return heading("Cross-play", played.fresh, played.runs.values(), each, f", diagonal: {played.diagonal}")


def crossplay_tables(played: CrossPlay) -> Iterator[Cells]:
    """A matrix of what focal agents gain, one of what background agents do, and one for each metric, rows the
    focal agent's run, columns the background agents' run; and all returns by the focal agent's index."""
    cells = {pair: cell.measures() for pair, cell in played.cells.items()}
    rewards, names, corner = unit_of_rewards(played), list(played.runs), "focal \\ background"
    by_cell = gains(played)
    for whose, texts in _texts(by_cell).items():
        name = with_unit(f"{whose}/return", rewards=rewards)
        title = f"{name}, difference of {_BESIDE[whose]}, paired by replica [95 % interval by Student's t]"
        yield matrix_table(title, corner, names, texts, f"{HOLM} for all {2 * len(by_cell)} differences")
    # A reward is an apple but for what institutions take and give.
    repeats = () if any("institutions/fines" in cell for cell in cells.values()) else ("collective_return",)
    for name in next(iter(cells.values())):
        measured = {pair: cell[name] for pair, cell in cells.items()}
        if name not in repeats and not says_nothing(name, measured.values()):
            note = "\n".join(notes_on([*measured.values()]))
            yield matrix_table(with_unit(name, rewards=rewards), corner, names, measured, note)
    returns = ("focal/return", "background/return", "group/return")
    headings = ["focal", "background", "focal agent", *(with_unit(name, rewards=rewards) for name in returns)]
    rows = []
    for pair, cell in played.cells.items():
        for agent in cell.by_agent:
            measures = cell.measures(agent)
            rows.append((*pair, str(agent), *(str(measures[name]) for name in returns)))
    yield Cells("returns by the focal agent's index", headings, rows, texts=3)


def matrix_table(
    title: str, corner: str, names: Sequence[str], cells: Mapping[Pair, object], note: str = ""
) -> Cells:
    """A row and a column for each name, with the text of each pair, "" where there is none."""
    rows = [(row, *(str(cells.get((row, column), "")) for column in names)) for row in names]
    return Cells(title, [corner, *names], rows, note)
