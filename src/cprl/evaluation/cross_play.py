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
from itertools import product
from pathlib import Path
from typing import Final

import pyarrow as pa

from cprl.evaluation.evaluate import opened, refuse_other_games
from cprl.evaluation.lanes import agents_of, fresh_for, play, roles_of, said, together
from cprl.evaluation.pages import draw_matrices, heading, matrix_cells, row_cells
from cprl.measuring.registry import COLLECTIVE_RETURN, FINES, INCOME, with_unit
from cprl.measuring.statistics import HOLM, Family, differences, estimates
from cprl.measuring.table import BACKGROUND, BOTH, FOCAL, ROLE, Label, labelled, numbers_in, where
from cprl.system.defaults import Diagonal, Fresh
from cprl.system.working import working
from cprl.terminal import style
from cprl.terminal.summary import rewards_of, says_nothing
from cprl.terminal.tables import Cells
from cprl.training.stored import LoadedRun
from cprl.values import checked, refusal

SELF_PLAY: Final = -1
"""The focal agent of self-play in tables: every agent is focal and background."""
PAIR: Final = (FOCAL, BACKGROUND)
"""The labels of a cell: the names of the focal agent's run and of the background agents' run."""
OF_FOCAL: Final = "focal/return"
OF_BACKGROUND: Final = "background/return"
RETURNS: Final = (OF_FOCAL, OF_BACKGROUND, INCOME)

Runs = Sequence[str | Path | LoadedRun] | Mapping[str, str | Path | LoadedRun]


@working("playing each other")
def crossplay(runs: Runs, fresh: Fresh = Fresh(), *, diagonal: Diagonal = "self") -> pa.Table:
    """Let agents of each run play with agents of each other run, one focal agent at a time.

    Args:
        runs: at least two runs of the same game: directories, exported results, or values of `cprl.load`;
            or a table of them by the names that they get, which are otherwise those of their directories.
        fresh: which episodes, with each focal agent.
        diagonal: the pairing of a run with itself: "self", agents that were trained together, or
            "cross_seed", a focal agent of the run's next replica.

    Returns:
        A row for each cell, focal agent, replica, episode and agent, see `cprl.measuring.table`, by "focal"
        and "background", the names of runs, and "focal_agent", -1 in self-play. The replica is that of the
        background agents.
    """
    checked("diagonal", diagonal, Diagonal)
    named = named_runs(runs)
    fresh = fresh_for(named.values(), fresh)
    numbers = fresh.replicas
    if diagonal == "cross_seed" and len(numbers) < 2:
        raise ValueError(f"the replicas are {list(numbers)}; allowed for cross_seed: at least 2")
    following = dict(zip(numbers, (*numbers[1:], numbers[0]), strict=True))

    def cell(focal: str, background: str) -> Iterator[pa.Table]:
        home = agents_of(named[background])
        populations = {SELF_PLAY: (home, [BOTH] * len(home))}
        if focal != background or diagonal != "self":
            visitors = agents_of(named[focal], following if focal == background else None)
            populations = {
                agent: ([*home[:agent], visitor, *home[agent + 1 :]], roles_of(len(home), [agent]))
                for agent, visitor in enumerate(visitors)
            }
        for agent, (agents, roles) in populations.items():
            labels: Label = {FOCAL: focal, BACKGROUND: background, "focal_agent": agent}
            yield play(fresh, named[background], agents, labels, roles=roles, among=named.values())

    each = " with focal agent at each index"
    return together(
        (part for pair in product(named, repeat=2) for part in cell(*pair)),
        heading=heading("Cross-play", fresh, named.values(), each, f", diagonal: {diagonal}"),
        fresh=fresh,
        diagonal=diagonal,
    )


def named_runs(runs: Runs) -> dict[str, LoadedRun]:
    """Return runs of the same game of several agents by given names, by names of their directories, or by
    their paths if those coincide."""
    loaded = [opened(run) for run in (runs.values() if isinstance(runs, Mapping) else runs)]
    if len(loaded) < 2:
        raise refusal("the number of runs", len(loaded), "at least two")
    paths = [run.path.resolve() for run in loaded]
    twice = [path for path in paths if paths.count(path) > 1]
    if twice:
        raise ValueError(f"{twice[0]} is given twice; allowed: different runs")
    names = list(runs) if isinstance(runs, Mapping) else [path.name for path in paths]
    if len(set(names)) < len(names):
        names = list(map(str, paths))
    named = dict(zip(names, loaded, strict=True))
    refuse_other_games(named)
    if loaded[0].game.agents == 1:
        raise ValueError("the game has 1 agent; allowed: at least 2; use `cprl evaluate`")
    return named


def gains(table: pa.Table) -> Family:
    """Return what focal and background agents of a cross-play get more than the same background agents among
    themselves, by "focal" and "background".

    "focal/return" is compared with the agent whose place the focal agent takes, "background/return" with the
    same agents of the diagonal. Replicas are paired, because both cells have the same background agents and
    worlds. With diagonal="cross_seed" the agent whose place is taken was not trained with the background
    agents either, so that a gain is due to the run alone.
    """

    def at_home(cell: Mapping[str, str]) -> dict[str, str]:
        return {FOCAL: cell[BACKGROUND]}

    return differences(table, [OF_FOCAL, OF_BACKGROUND], PAIR, at_home)


def by_focal_agent(table: pa.Table) -> pa.Table:
    """Return the table of a cross-play in which each agent of self-play is the focal one in turn."""
    agents = len(table["agent"].unique())
    parts = []
    for agent in range(agents):
        part = where(table, focal_agent=(agent, SELF_PLAY)).drop_columns(["focal_agent", ROLE])
        roles = pa.array(roles_of(agents, [agent])).take(part["agent"])
        parts.append(labelled(part, focal_agent=agent).append_column(ROLE, roles))
    return pa.concat_tables(parts).select(table.column_names)


_BESIDE: Final = {
    OF_FOCAL: "the focal agent, beside the agent whose place it takes",
    OF_BACKGROUND: "the background agents, beside themselves without it",
}


def draw_gains(table: pa.Table, path: Path | str, *, width: style.Width = "page") -> Path:
    """Draw `gains`, a row for each focal agent's run, a column for each of background agents; on the diagonal
    an agent's return. A star where one is not 0 by Holm's method for all that are drawn."""
    gained = gains(table)
    at_home = {key[:-1]: one for key, one in estimates(table, OF_FOCAL, PAIR).items() if key[0] == key[1]}
    unit = f", {rewards_of(table)}".removesuffix(", ")
    diagonal = said(table, "diagonal").replace("_", "-")
    return draw_matrices(
        path,
        gained,
        _BESIDE,
        title="Cross-play: who gains among whom",
        caption=(
            f"Difference in return{unit}; {said(table, 'fresh')} with focal agent at each index; diagonal "
            f"({diagonal}): an agent's return. {HOLM} for these {len(gained)}."
        ),
        more={pair: f"{one.value:.3g}" for pair, one in at_home.items()},
        width=width,
    )


def crossplay_cells(table: pa.Table) -> Iterator[Cells]:
    """Yield a matrix of what focal agents gain, one of what background agents do, and one for each number,
    rows the focal agent's run, columns the background agents' run; and all returns by the focal agent's
    index."""
    rewards = rewards_of(table)
    gained = gains(table)
    for number, beside in _BESIDE.items():
        name = with_unit(number, rewards=rewards)
        title = f"{name}, difference of {beside}, paired by replica [95 % interval by Student's t]"
        yield matrix_cells(gained, number, title, gained.note("of both tables"))
    numbers = dict.fromkeys([*RETURNS, *numbers_in(table)])
    if FINES not in table.column_names:  # a reward is an apple then
        numbers.pop(COLLECTIVE_RETURN, None)
    levels = estimates(table, list(numbers), PAIR)
    for number in numbers:
        if not says_nothing(number, levels):
            yield matrix_cells(levels, number, with_unit(number, rewards=rewards))
    by_agent = estimates(by_focal_agent(table), RETURNS, (*PAIR, "focal_agent"))
    yield row_cells(by_agent, "returns by the focal agent's index", rewards=rewards)
