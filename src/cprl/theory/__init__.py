"""Games with a known answer: what theory expects of those who share a resource, and what games that were
measured amount to.

Modules, in the order in which one reads them:
    worth         what a unit is worth when so many are taken in all
    sharing       SharingGame: equilibrium, optimum, price of anarchy; the herders' game, and appropriation
    growth        yield_bounds: what the apples of any map can bear, from below and from above
    payoff_table  PayoffTable: a symmetric game with a few strategies, by how many agents play each
    equilibria    Nash equilibria of two agents, by nashpy
    evolution     alpha-rank and replicator dynamics, by OpenSpiel
    extras        the packages of the extra "theory"
"""

from cprl.theory.equilibria import Equilibrium, equilibria
from cprl.theory.evolution import AlphaRank, Ends, alpha_rank, replicator, replicator_ends
from cprl.theory.growth import YieldBounds, yield_bounds
from cprl.theory.payoff_table import PayoffTable, compositions, sharing_table
from cprl.theory.sharing import SharingGame, appropriation, herders
from cprl.theory.worth import CallableWorth, PowerWorth, Worth

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
    "sharing_table",
    "yield_bounds",
]
