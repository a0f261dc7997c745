"""Evaluations and cross-play as tables for the terminal."""

from collections.abc import Iterator
from typing import Final

from rich.table import Table

from cprl.evaluation.cross_play import CrossPlay
from cprl.evaluation.evaluate import Evaluation
from cprl.evaluation.lanes import Played
from cprl.measuring.replicas import agents_without_harvest
from cprl.stored import LoadedRun


def run_table(evaluation: Evaluation) -> Table:
    """A row for each metric: mean over replicas and 95 % interval, of the run's agents and at random."""
    replicas = len(evaluation.trained)
    episodes = len(next(iter(evaluation.trained.values())))
    table = Table(
        title=f"{evaluation.run.path.name}: {replicas} replicas, {episodes} episodes each, "
        f"seed {evaluation.seed}\n{_INTERVALS}"
    )
    table.add_column()
    table.add_column(f"run's agents{how_they_play([evaluation.run], evaluation.greedy)}", justify="right")
    table.add_column("random", justify="right")
    trained, random = evaluation.measures("trained"), evaluation.measures("random")
    for name, measured in trained.items():
        table.add_row(name, str(measured), str(random[name]))
    table.add_row(
        "agents without a harvest, not in sustainability",
        _without_harvest(evaluation.trained),
        _without_harvest(evaluation.random),
    )
    return table


def heading(played: CrossPlay) -> str:
    """What the matrices are of."""
    how = how_they_play(list(played.runs.values()), played.greedy)
    return (
        f"Cross-play: {len(played.replicas)} replicas, {played.episodes} episodes each with the visitor at "
        f"every seat, seed {played.seed}{how}, diagonal: {played.diagonal}\n{_INTERVALS}"
    )


def matrices(played: CrossPlay) -> Iterator[Table]:
    """A matrix for each measure of the cells: rows visit, columns are the hosts."""
    cells = {at: cell.measures() for at, cell in played.cells.items()}
    for name in next(iter(cells.values())):
        if name == "collective_return":  # a reward is an apple: group/return says the same
            continue
        table = Table(title=name, title_justify="left")
        table.add_column("visitor \\ hosts")
        for hosts in played.runs:
            table.add_column(hosts, justify="right")
        for visitor in played.runs:
            table.add_row(visitor, *(str(cells[visitor, hosts][name]) for hosts in played.runs))
        yield table


def seats_table(played: CrossPlay) -> Table:
    """The returns of each cell with the visitor at each seat."""
    table = Table(title="returns by the visitor's seat", title_justify="left")
    for heading in ("visitor", "hosts", "seat"):
        table.add_column(heading)
    names = ("visitor/return", "hosts/return", "group/return")
    for name in names:
        table.add_column(name, justify="right")
    for (visitor, hosts), cell in played.cells.items():
        for agent in cell.visits:
            measured = cell.measures(agent)
            table.add_row(visitor, hosts, str(agent), *(str(measured[name]) for name in names))
    return table


def how_they_play(runs: list[LoadedRun], greedy: bool) -> str:
    """With what chance the agents that learned values explore, for people."""
    if greedy:
        return ", greedy"
    learned = [run.agent(agent, replica=run.replicas[0]) for run in runs for agent in run.algorithms]
    chances = {epsilon for _, stochastic, epsilon in learned if not stochastic}
    return "".join(f", epsilon {chance:g}" for chance in sorted(chances))


def _without_harvest(played: Played) -> str:
    none, all_agents = agents_without_harvest(played)
    return f"{none} of {all_agents}"


_INTERVALS: Final = "mean over replicas [95 % bootstrap interval]"
