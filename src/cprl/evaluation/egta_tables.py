"""What an empirical game amounts to, as tables for the terminal."""

from collections.abc import Iterator, Sequence
from math import isnan
from typing import Final

import numpy as np
from rich.table import Table

from cprl.evaluation.egta import Analysis
from cprl.evaluation.empirical_game import EmpiricalGame
from cprl.evaluation.tables import how_they_play
from cprl.measuring.statistics import Estimate, estimate
from cprl.theory.payoff_table import Values, compositions

_LEAST: Final = 0.005
"""Smaller shares are not told."""


def egta_heading(game: EmpiricalGame) -> str:
    """The heading of the tables."""
    how = how_they_play(list(game.runs.values()), game.greedy)
    kind = "Pairwise reduction of the empirical game" if game.is_reduction else "Empirical game"
    return (
        f"{kind}: {how_much_was_played(game)}, seed {game.seed}{how}\n"
        "returns: mean over replicas [95 % interval by Student's t]"
    )


def how_much_was_played(game: EmpiricalGame) -> str:
    """Replicas and episodes, in words."""
    replicas, episodes = len(game.replicas), game.episodes
    return (
        f"{replicas} replica{'s' * (replicas != 1)}, {episodes} episode{'s' * (episodes != 1)} each for each "
        "choice of who plays where"
    )


def egta_tables(found: Analysis) -> Iterator[Table]:
    """The payoffs, the runs by alpha-rank, the equilibria, and where replicator dynamics end."""
    game = found.game
    yield _pairs(game) if game.agents == 2 else _compositions(game)
    yield _runs(found)
    yield _equilibria(found)


def _pairs(game: EmpiricalGame) -> Table:
    others = "the other" if game.of_agents == 2 else f"all other {game.of_agents - 1}"
    title = f"return of an agent, by its run and that of {others}"
    table = Table(title=title, title_justify="left")
    table.add_column("an agent \\ others")
    for name in game.names:
        table.add_column(name, justify="right")
    pairs = np.array([game.table([place]).pairs for place in range(len(game.payoffs))])
    for place, name in enumerate(game.names):
        table.add_row(name, *(str(estimate(pairs[:, place, other])) for other in range(len(game.names))))
    return table


def _compositions(game: EmpiricalGame) -> Table:
    title = "return of an agent of each run, by how many agents play as each"
    table = Table(title=title, title_justify="left")
    table.add_column("agents")
    for name in game.names:
        table.add_column(name, justify="right")
    for row, counts in enumerate(compositions(game.agents, len(game.names)).tolist()):
        own = (str(estimate(game.payoffs[:, row, run])) if count else "" for run, count in enumerate(counts))
        table.add_row(composition_text(counts, game.names), *own)
    return table


def _runs(found: Analysis) -> Table:
    title = "alpha-rank at the limit of infinite alpha: share of the agents in the long run"
    if found.resamples:
        title += f" [95 % interval, {found.resamples} resamples of the replicas]"
    table = Table(title=title, title_justify="left")
    table.add_column("run")
    table.add_column("share", justify="right")
    is_told = not np.isnan(found.in_support).any()
    if is_told:
        table.add_column("resamples in which a symmetric equilibrium plays it", justify="right")
    for name, share, certain in zip(found.game.names, found.shares, found.in_support, strict=True):
        table.add_row(name, _share(share), *([f"{certain:.0%}"] if is_told else []))
    return table


def _equilibria(found: Analysis) -> Table:
    game = found.game
    table = Table(title="equilibria", title_justify="left")
    table.add_column("")
    table.add_column("what is played")
    table.add_column("how certain", justify="right")
    for counts, certain in found.pure.items():
        told = "" if isnan(certain) else f"in {certain:.0%} of the resamples"
        table.add_row("no agent gains by another run", composition_text(counts, game.names), told)
    if not found.pure:
        table.add_row("no agent gains by another run", "no composition", "")
    of_pair = "Nash equilibrium (nashpy)" if game.agents == 2 else "Nash equilibrium of pairs (nashpy)"
    for own in found.equilibria:
        both = [mixture_text(side, game.names) for side in (own.first, own.second)]
        table.add_row(of_pair, both[0] if own.is_symmetric else " against ".join(both), "")
    for mixture, share in zip(found.ends.mixtures, found.ends.shares, strict=True):
        told = f"from {share:.0%} of the starts"
        table.add_row("end of replicator dynamics", mixture_text(mixture, game.names), told)
    if found.ends.unsettled > 0:
        told = f"from {found.ends.unsettled:.0%} of the starts"
        table.add_row("end of replicator dynamics", "none, or a late one", told)
    return table


def composition_text(counts: Sequence[int], names: Sequence[str]) -> str:
    """A composition in words, e.g. "3 dqn, 1 ppo"."""
    return ", ".join(f"{count} {name}" for count, name in zip(counts, names, strict=True) if count)


def mixture_text(mixture: Values, names: Sequence[str]) -> str:
    """A mixture in words, e.g. "dqn 0.75, ppo 0.25"; one strategy by its name alone."""
    told = [(name, share) for name, share in zip(names, mixture, strict=True) if share >= _LEAST]
    return told[0][0] if len(told) == 1 else ", ".join(f"{name} {share:.2f}" for name, share in told)


def _share(own: Estimate) -> str:
    told = f"{own.value:.2f}"
    return told if isnan(own.low) else f"{told} [{own.low:.2f}, {own.high:.2f}]"
