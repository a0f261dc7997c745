"""Evaluations and cross-play as tables for the terminal."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Final

from rich.table import Table

from cprl.evaluation.cross_play import CrossPlay
from cprl.evaluation.evaluate import Evaluation
from cprl.evaluation.gains import gains
from cprl.evaluation.lanes import Played
from cprl.evaluation.schelling import SchellingDiagram
from cprl.evaluation.territory import Territory
from cprl.measuring.names import with_unit
from cprl.measuring.replicas import Measured, agents_without_harvest
from cprl.measuring.reported import left_out
from cprl.measuring.statistics import estimate
from cprl.stored import LoadedRun


def run_table(evaluation: Evaluation) -> Table:
    """A row for each metric: mean over replicas and 95 % interval, of the run's agents and random agents.

    Metrics of institutions that are undefined everywhere, since the game has other institutions, have none.
    """
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
    rewards = _unit_of_rewards(evaluation.trained)
    for name, measured in trained.items():
        if _says_nothing(name, [measured, random[name]]):
            continue
        table.add_row(with_unit(name, rewards=rewards), str(measured), str(random[name]))
    without = [agents_without_harvest(played) for played in (evaluation.trained, evaluation.random)]
    if None not in without:
        table.add_row(
            "agents without a harvest, not in sustainability",
            *(f"{own[0]} of {own[1]}" for own in without if own),
        )
    table.caption = left_out(next(iter(evaluation.trained.values()))[0].reported) or None
    return table


def territory_table(found: Territory) -> Table:
    """A row for each measure of territory: mean over replicas and 95 % interval, of the run's agents and of
    random ones; a dash where it is undefined in all."""
    count = len(found.replicas)
    table = Table(
        title=f"{found.run.path.name}: {count} replica{'s' * (count != 1)}, {found.episodes} episodes each, "
        f"seed {found.seed}\n{_INTERVALS}"
    )
    table.add_column()
    table.add_column(f"run's agents{how_they_play([found.run], found.greedy)}", justify="right")
    table.add_column("random", justify="right")
    trained, random = found.trained.measures(), found.random.measures()
    for name in found.trained.by_replica:
        table.add_row(name, *(str(own.get(name, "-")) for own in (trained, random)))
    return table


def schelling_tables(found: SchellingDiagram) -> Iterator[Table]:
    """The payoffs by the number of restrained others, and the margins between them that make a dilemma."""
    title = (
        f"{found.replicas} replicas, {found.episodes} episodes each for each choice of restrained agents, "
        f"seed {found.seed}\n{_INTERVALS}"
    )
    payoffs = Table(title=title, title_justify="left")
    for heading in (
        f"restrained among the other {found.agents - 1}",
        f"return of {found.restrained} (restrained)",
        f"return of {found.greedy} (greedy)",
    ):
        payoffs.add_column(heading, justify="right")
    for count in range(found.agents):
        own = (of_kind[:, count] for of_kind in (found.restrained_payoffs, found.greedy_payoffs))
        payoffs.add_row(str(count), *(str(estimate(values)) for values in own))
    yield payoffs
    dilemma, last = found.dilemma(), found.agents - 1
    margins = Table(title=f"{dilemma.name}, by returns", title_justify="left")
    margins.add_column()
    margins.add_column("difference, paired by replica", justify="right")
    for name, margin in (
        (f"restraint of all instead of none, R({last}) - G(0)", dilemma.restraint),
        (f"company of the restrained, R({last}) - R(0)", dilemma.company),
        ("fear, G(0) - R(0)", dilemma.fear),
        (f"greed, G({last}) - R({last})", dilemma.greed),
    ):
        margins.add_row(name, str(margin))
    yield margins


def heading(played: CrossPlay) -> str:
    """The heading of the matrices."""
    how = how_they_play(list(played.runs.values()), played.greedy)
    return (
        f"Cross-play: {len(played.replicas)} replicas, {played.episodes} episodes each with focal agent at "
        f"each index, seed {played.seed}{how}, diagonal: {played.diagonal}\n{_INTERVALS}"
    )


def matrices(played: CrossPlay) -> Iterator[Table]:
    """A matrix for each metric: rows are the focal agent's run, columns the background agents' run."""
    cells = {at: cell.measures() for at, cell in played.cells.items()}
    rewards = unit_of_cells(played)
    for name in next(iter(cells.values())):
        of_name = [measured[name] for measured in cells.values()]
        if _says_nothing(name, of_name) or _repeats(name, cells.values()):
            continue
        table = Table(title=with_unit(name, rewards=rewards), title_justify="left")
        table.add_column("focal \\ background")
        for background in played.runs:
            table.add_column(background, justify="right")
        for focal in played.runs:
            table.add_row(focal, *(str(cells[focal, background][name]) for background in played.runs))
        yield table


def gains_tables(played: CrossPlay) -> Iterator[Table]:
    """A matrix of what focal agents gain, and one of what background agents do; see `gains`."""
    found = gains(played)
    rewards = unit_of_cells(played)
    for whose, beside in (("focal", "the agent whose place it takes"), ("background", "the diagonal")):
        title = with_unit(f"{whose}/return", rewards=rewards)
        table = Table(
            title=f"{title}, difference from {beside}, paired by replica [95 % interval by Student's t]",
            title_justify="left",
        )
        table.add_column("focal \\ background")
        for background in played.runs:
            table.add_column(background, justify="right")
        for focal in played.runs:
            own = (found.get((focal, background)) for background in played.runs)
            table.add_row(focal, *("" if gain is None else str(getattr(gain, whose)) for gain in own))
        yield table


def agents_table(played: CrossPlay) -> Table:
    """The returns of each cell by the index of the focal agent."""
    table = Table(title="returns by the focal agent's index", title_justify="left")
    for heading in ("focal", "background", "focal agent"):
        table.add_column(heading)
    names, rewards = ("focal/return", "background/return", "group/return"), unit_of_cells(played)
    for name in names:
        table.add_column(with_unit(name, rewards=rewards), justify="right")
    for (focal, background), cell in played.cells.items():
        for agent in cell.by_agent:
            measured = cell.measures(agent)
            table.add_row(focal, background, str(agent), *(str(measured[name]) for name in names))
    return table


def _says_nothing(name: str, measured: Iterable[Measured]) -> bool:
    """Whether it is a metric of institutions that is undefined everywhere."""
    return name.startswith("institutions/") and all(own.estimate is None for own in measured)


def _repeats(name: str, cells: Iterable[Mapping[str, Measured]]) -> bool:
    """Whether group/return says the same: a reward is an apple but for what institutions take and give."""
    return name == "collective_return" and not any("institutions/fines" in own for own in cells)


def unit_of_cells(played: CrossPlay) -> str:
    """See `_unit_of_rewards`."""
    return _unit_of_rewards(next(iter(next(iter(played.cells.values())).by_agent.values())))


def _unit_of_rewards(played: Played) -> str:
    """Rewards are apples in a game that reports harvests; in another they have no unit."""
    return "apples" if next(iter(played.values()))[0].harvest is not None else ""


def how_they_play(runs: list[LoadedRun], greedy: bool) -> str:
    """The epsilon of the agents that learned values, as text."""
    if greedy:
        return ", greedy"
    agents = [run.agent(agent, replica=run.replicas[0]) for run in runs for agent in range(run.game.agents)]
    chances = {agent.kind[2] for agent in agents if agent.kind[0] == "trained" and not agent.kind[1]}
    return "".join(f", epsilon {chance:g}" for chance in sorted(chances))


_INTERVALS: Final = "mean over replicas [95 % interval by Student's t]"
