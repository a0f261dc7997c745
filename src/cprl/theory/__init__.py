"""Games with a known answer: what theory expects of those who share a resource, and what games that were
measured amount to.

Modules, in the order in which one reads them:
    sharing       SharingGame: equilibrium, optimum, price of anarchy; the herders' game, and appropriation;
                  Worth, what a unit is worth when so many are taken in all
    growth        yield_bounds: what the apples of any map can bear, from below and from above
    payoff_table  PayoffTable: a symmetric game with a few strategies, by how many agents play each
    solutions     Nash equilibria of two agents, alpha-rank and replicator dynamics, by nashpy and OpenSpiel
"""

from cprl.theory.growth import YieldBounds, yield_bounds
from cprl.theory.payoff_table import PayoffTable, compositions
from cprl.theory.sharing import CallableWorth, PowerWorth, SharingGame, Worth, appropriation, herders
from cprl.theory.solutions import (
    AlphaRank,
    Ends,
    Equilibrium,
    alpha_rank,
    equilibria,
    replicator,
    replicator_ends,
)

__all__ = [
    "AlphaRank",
    "CallableWorth",
    "Ends",
    "Equilibrium",
    "PayoffTable",
    "PowerWorth",
    "SharingGame",
    "Worth",
    "YieldBounds",
    "alpha_rank",
    "appropriation",
    "compositions",
    "equilibria",
    "herders",
    "replicator",
    "replicator_ends",
    "yield_bounds",
]
