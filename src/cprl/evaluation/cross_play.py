"""crossplay: a focal agent of one stored run plays with background agents of another.

The results form a matrix. In cell (i, j) one agent, the focal agent, is from run i, and all others, the
background agents, are from run j. Every index of the population is that of the focal agent in turn, every
replica plays, and all cells are played in the same worlds. The value of a cell is a mean over focal agents,
estimated over replicas.

The diagonal is self-play: there the focal agent was trained together with the background agents. In all other
cells it is from another run, and was not trained with them: two differences at once. With
diagonal="cross_seed" the focal agent of the diagonal is from the run's next replica, trained in the same way
but not together with the background agents, so that only the first difference remains.
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, Final, NamedTuple

import pyarrow as pa
from matplotlib.axes import Axes

from cprl.evaluation.pages import heading, matrix_labels, matrix_table, row_table
from cprl.evaluation.populations import (
    AgentOfReplica,
    agents_of,
    fresh_for,
    join_tables,
    play_fresh,
    roles_of,
    table_note,
)
from cprl.measuring.registry import COLLECTIVE_RETURN, FINES_TOTAL, INCOME, with_unit
from cprl.measuring.statistics import HOLM_NOTE, Family, differences, estimates
from cprl.measuring.table import BACKGROUND, BOTH, FOCAL, ROLE, all_metrics, labelled, where
from cprl.system.defaults import Diagonal, Fresh
from cprl.system.working import working
from cprl.terminal import picture_files, style
from cprl.terminal.panels import draw_matrix, matrix_height
from cprl.terminal.summary import is_empty_row, rewards_of
from cprl.terminal.text_tables import TextTable
from cprl.training.stored import LoadedRun, as_loaded, refuse_other_games
from cprl.values import checked, refusal

_SELF_PLAY: Final = -1
"""The value of "focal_agent" in rows of self-play, in which every agent is both focal and background."""
CELL_LABELS: Final = (FOCAL, BACKGROUND)
"""The labels of a cell: the names of the focal agent's run and of the background agents' run."""
FOCAL_RETURN: Final = "focal/return"
BACKGROUND_RETURN: Final = "background/return"
CROSS_PLAY_RETURNS: Final = (FOCAL_RETURN, BACKGROUND_RETURN, INCOME)
"""The returns of a cross-play: per focal agent, per background agent, and of all agents together."""
_GAIN_SIDES: Final = {
    FOCAL_RETURN: "the focal agent, beside the agent whose place it takes",
    BACKGROUND_RETURN: "the background agents, beside themselves without it",
}
"""The returns of which `gains` are drawn, each with the words for its two sides."""

Runs = Sequence[str | Path | LoadedRun] | Mapping[str, str | Path | LoadedRun]
"""Runs as directories or loaded, in a list, or in a mapping from the names that they get in tables."""


@working("playing each other")
def crossplay(runs: Runs, fresh: Fresh = Fresh(), *, diagonal: Diagonal = "self") -> pa.Table:
    """Let agents of each run play with agents of each other run, one focal agent at a time.

    Args:
        runs: at least two runs of the same game: directories, exported results, or values of `cprl.load`.
            A mapping gives them names; by default they are named after their directories.
        fresh: the number of episodes with each focal agent, their seed, and the replicas that play.
        diagonal: how a run is paired with itself: "self", all agents of one replica; or "cross_seed", a focal
            agent of the run's next replica.

    Returns:
        A table with a row for each cell, focal agent, replica, episode and agent, see
        `cprl.measuring.table`. The columns "focal" and "background" have the names of the runs, "focal_agent"
        the index of the focal agent, -1 in self-play. "replica" is that of the background agents.

    Raises:
        ValueError: for fewer than two runs, a run given twice, runs of different games or of a game with one
            agent, no replica in common, or a seed with which a run was trained.
    """
    checked("diagonal", diagonal, Diagonal)
    loaded = load_by_name(runs)
    fresh = fresh_for(loaded.values(), fresh)
    replicas = fresh.replicas
    if diagonal == "cross_seed" and len(replicas) < 2:
        raise ValueError(f"the replicas are {list(replicas)}; allowed for cross_seed: at least 2")
    next_replica = dict(zip(replicas, (*replicas[1:], replicas[0]), strict=True))
    tables = (
        play_fresh(
            fresh,
            loaded[cell.labels[BACKGROUND]],
            cell.agents,
            cell.labels,
            roles=cell.roles,
            compared_runs=loaded.values(),
        )
        for cell in _cells(loaded, diagonal, next_replica)
    )
    per_focal_agent = " with focal agent at each index"
    return join_tables(
        tables,
        heading=heading("Cross-play", fresh, loaded.values(), per_focal_agent, f", diagonal: {diagonal}"),
        fresh=fresh,
        diagonal=diagonal,
    )


class _Cell(NamedTuple):
    """What is played for one index of the focal agent in a cell of the matrix."""

    labels: dict[str, Any]
    """The values of `CELL_LABELS` and of "focal_agent" in the table."""
    agents: list[AgentOfReplica]
    roles: list[str]
    """The role of each agent."""


def _cells(
    runs: Mapping[str, LoadedRun], diagonal: Diagonal, next_replica: Mapping[int, int]
) -> Iterator[_Cell]:
    """Yield what is played for each cell and each index of the focal agent.

    Args:
        runs: the runs by name.
        diagonal: as in `crossplay`.
        next_replica: with "cross_seed", the replica of the focal agent by that of the background agents.
    """
    for focal, background in product(runs, repeat=2):
        labels = {FOCAL: focal, BACKGROUND: background}
        background_agents = agents_of(runs[background])
        if focal == background and diagonal == "self":
            roles = [BOTH] * len(background_agents)
            yield _Cell(labels | {"focal_agent": _SELF_PLAY}, background_agents, roles)
            continue
        focal_agents = agents_of(runs[focal], next_replica if focal == background else None)
        for index, focal_agent in enumerate(focal_agents):
            agents = [*background_agents[:index], focal_agent, *background_agents[index + 1 :]]
            yield _Cell(labels | {"focal_agent": index}, agents, roles_of(len(agents), [index]))


def load_by_name(runs: Runs) -> dict[str, LoadedRun]:
    """Load runs, and return them by name; refuse runs of different games, or of a game with one agent.

    A run's name is the one it is given, or else that of its directory, or its whole path if two directories
    have the same name.
    """
    values = runs.values() if isinstance(runs, Mapping) else runs
    loaded = [as_loaded(run) for run in values]
    if len(loaded) < 2:
        raise refusal("the number of runs", len(loaded), "at least two")
    paths = [run.path.resolve() for run in loaded]
    repeated = [path for path in paths if paths.count(path) > 1]
    if repeated:
        raise ValueError(f"{repeated[0]} is given twice; allowed: different runs")
    names = list(runs) if isinstance(runs, Mapping) else [path.name for path in paths]
    if len(set(names)) < len(names):
        names = list(map(str, paths))
    by_name = dict(zip(names, loaded, strict=True))
    refuse_other_games(by_name)
    if loaded[0].game.agents == 1:
        raise ValueError("the game has 1 agent; allowed: at least 2; use `cprl evaluate`")
    return by_name


def gains(table: pa.Table) -> Family:
    """Return how much more agents get in each cell of a cross-play than on the diagonal.

    Each cell is compared with the diagonal's cell of the same background agents: "focal/return" with the
    return of the agent whose place the focal agent takes, "background/return" with that of the same
    background agents. Differences are paired by replica, because both cells have the same background agents
    and worlds. With diagonal="cross_seed" the replaced agent was not trained with the background agents
    either, so that a gain comes from the focal agent's run alone.

    Returns:
        The differences; the keys of the family are (focal, background, metric).
    """

    def diagonal_cell(cell: Mapping[str, str]) -> dict[str, str]:
        return {FOCAL: cell[BACKGROUND]}

    return differences(table, [FOCAL_RETURN, BACKGROUND_RETURN], CELL_LABELS, diagonal_cell)


def by_focal_agent(table: pa.Table) -> pa.Table:
    """Return the table of a cross-play with a focal agent in every row.

    Self-play rows belong to no single focal agent: they are repeated for each agent index, with roles as if
    that agent were focal.
    """
    agents = len(table["agent"].unique())
    tables = []
    for agent in range(agents):
        rows = where(table, focal_agent=(agent, _SELF_PLAY)).drop_columns(["focal_agent", ROLE])
        roles = pa.array(roles_of(agents, [agent])).take(rows["agent"])
        tables.append(labelled(rows, focal_agent=agent).append_column(ROLE, roles))
    return pa.concat_tables(tables).select(table.column_names)


def draw_gains(table: pa.Table, path: Path | str, *, width: style.Width = "page") -> Path:
    """Draw the `gains` as two matrices, with an agent's return on the diagonal.

    The focal agent's run has rows, and that of the background agents columns. A star marks gains that differ
    from 0 by Holm's method for all drawn gains.
    """
    gain_estimates = gains(table)
    returns = estimates(table, FOCAL_RETURN, CELL_LABELS).column(FOCAL_RETURN)
    diagonal_returns = {pair: f"{returns[pair].value:.3g}" for pair in returns if pair[0] == pair[1]}
    rewards = rewards_of(table)
    unit = f", {rewards}" if rewards else ""
    diagonal_word = table_note(table, "diagonal").replace("_", "-")
    rows = len(matrix_labels(gain_estimates)[0])
    with style.drawing(path, width=width, colours=picture_files.PNG_SHADES) as sheet:
        panels = sheet.panels(len(_GAIN_SIDES), row_height_em=matrix_height(rows))
        for axes, metric in zip(panels, _GAIN_SIDES, strict=True):
            _draw_gain_panel(sheet, axes, metric, gain_estimates, diagonal_returns)
        sheet.title = "Cross-play: who gains among whom"
        sheet.caption = (
            f"Difference in return{unit}; {table_note(table, 'fresh')} with focal agent at each index; "
            f"diagonal ({diagonal_word}): an agent's return. {HOLM_NOTE} for these {len(gain_estimates)}."
        )
    return Path(path)


def _draw_gain_panel(
    sheet: style.Sheet, axes: Axes, metric: str, gain_estimates: Family, diagonal_returns: dict[Any, str]
) -> None:
    """Draw the gains in one return as a matrix, with an agent's return, as text, in the cells of the
    diagonal."""
    rows, columns = (dict(zip(labels, labels, strict=True)) for labels in matrix_labels(gain_estimates))
    values = {}
    texts = dict(diagonal_returns)
    for pair, estimate in gain_estimates.column(metric).items():
        values[pair] = estimate.value
        texts[pair] = f"{estimate.value:+.3g}" + " *" * estimate.differs
    draw_matrix(sheet, axes, rows, columns, values, texts)
    axes.set(xlabel=BACKGROUND, ylabel=FOCAL)
    axes.set_title(_GAIN_SIDES[metric])


def crossplay_tables(table: pa.Table) -> Iterator[TextTable]:
    """Yield matrices of the gains and of all metrics, and a table of the returns by the focal agent's index.

    In a matrix the focal agent's run has rows, and that of the background agents columns.
    """
    rewards = rewards_of(table)
    gain_estimates = gains(table)
    for metric, sides in _GAIN_SIDES.items():
        name = with_unit(metric, rewards=rewards)
        title = f"{name}, difference of {sides}, paired by replica [95 % interval by Student's t]"
        yield matrix_table(gain_estimates, metric, title, gain_estimates.note("of both tables"))
    metrics = dict.fromkeys([*CROSS_PLAY_RETURNS, *all_metrics(table)])
    if FINES_TOTAL not in table.column_names:  # without fines the collective return equals the income
        metrics.pop(COLLECTIVE_RETURN, None)
    levels = estimates(table, list(metrics), CELL_LABELS)
    for metric in metrics:
        if not is_empty_row(metric, levels):
            yield matrix_table(levels, metric, with_unit(metric, rewards=rewards))
    by_agent = estimates(by_focal_agent(table), CROSS_PLAY_RETURNS, (*CELL_LABELS, "focal_agent"))
    yield row_table(by_agent, "returns by the focal agent's index", rewards=rewards)
