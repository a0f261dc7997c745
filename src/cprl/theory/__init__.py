"""Games with a known answer: what theory expects of those who share a resource.

Modules, in the order in which one reads them:
    worth     what a unit is worth when so many are taken in all
    sharing   SharingGame: equilibrium, optimum, price of anarchy; the herders' game, and appropriation
    growth    yield_bounds: what the apples of any map can bear, from below and from above
    yields    exact_yield: what those of a small map can bear, by value iteration
"""

from cprl.theory.growth import YieldBounds, yield_bounds
from cprl.theory.sharing import SharingGame, appropriation, herders
from cprl.theory.worth import CallableWorth, PowerWorth, Worth
from cprl.theory.yields import exact_yield

__all__ = [
    "CallableWorth",
    "PowerWorth",
    "SharingGame",
    "Worth",
    "YieldBounds",
    "appropriation",
    "exact_yield",
    "herders",
    "yield_bounds",
]
