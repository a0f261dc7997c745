"""The waiting room: what is here works and is tested, and may change from one version to the next.

Nothing outside imports it but commands and recipes. What carries the library stands in the other packages.

Modules, in the order in which one reads them:
    movement        where agents go, which cells they share or keep, and who tags whom
    territory       territory_of: where the agents of a stored run go and whom they tag, beside random play
    payoff_table    PayoffTable: a symmetric game with a few strategies, by how many agents play each
    solutions       Nash equilibria of two agents, alpha-rank and replicator dynamics, by nashpy and OpenSpiel
    empirical_game  play_empirical_game: the game whose strategies are runs; pairwise_game: of a cross-play;
                    analyse: which runs last in it, by alpha-rank, equilibria and replicator dynamics
"""

from cprl.experimental.empirical_game import Analysis, analyse, draw_egta, pairwise_game, play_empirical_game
from cprl.experimental.payoff_table import PayoffTable, compositions
from cprl.experimental.solutions import (
    AlphaRank,
    Ends,
    Equilibrium,
    alpha_rank,
    equilibria,
    replicator,
    replicator_ends,
)
from cprl.experimental.territory import draw_visits, territory_of

__all__ = [
    "AlphaRank",
    "Analysis",
    "Ends",
    "Equilibrium",
    "PayoffTable",
    "alpha_rank",
    "analyse",
    "compositions",
    "draw_egta",
    "draw_visits",
    "equilibria",
    "pairwise_game",
    "play_empirical_game",
    "replicator",
    "replicator_ends",
    "territory_of",
]
