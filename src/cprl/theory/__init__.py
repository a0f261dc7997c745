"""Games with a known answer: what theory expects of those who share a resource.

Modules, in the order in which one reads them:
    worth     what a unit is worth when so many are taken in all
    sharing   SharingGame: equilibrium, optimum, price of anarchy; the herders' game, and appropriation
    yields    what the apples of a small map can bear, exactly, and an upper bound for any map
"""

from cprl.theory.sharing import SharingGame, appropriation, herders
from cprl.theory.worth import CallableWorth, PowerWorth, Worth
from cprl.theory.yields import exact_yield, highest_yield

__all__ = [
    "CallableWorth",
    "PowerWorth",
    "SharingGame",
    "Worth",
    "appropriation",
    "exact_yield",
    "herders",
    "highest_yield",
]
