"""ClosedPatches: a patch is closed while it holds too few apples."""

import warnings
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np

from cprl.institutions.arrays import DERIVED
from cprl.institutions.base import Amount, Limit, columns, with_ballots
from cprl.values import Natural
from cprl.values.arrays import Bool, Float64, Int32, UInt8


@dataclass(frozen=True, kw_only=True)
class ClosedPatches(Limit):
    """A patch is closed while it holds too few apples (Ostrom's principle 2).

    A patch is a set of sites that are connected by being near each other (`Rules.regrow_radius_cells`). It is
    closed in every turn that begins with fewer than `below` apples on it. Agents observe, for each cell of
    their window, whether a bite there would break a rule.
    """

    below: Natural = 2
    """The number of apples below which a patch is closed."""

    fine: Amount | None = None
    """None: nobody can harvest in a closed patch. A number: it can be done, is a violation, and each bite
    costs so many apples if it is detected."""

    at_most: ClassVar[int | None] = 1
    shows_places: ClassVar[bool] = True
    counts: ClassVar[tuple[str, ...]] = ("closed_bites",)

    def check(self, game: Any) -> None:
        """Warn (UserWarning) if no patch ever opens, so that nobody gets an apple."""
        largest = int(np.bincount(game.patches).max())
        if self.is_stopped and self.below > largest:
            warnings.warn(
                f"no agent can harvest any site: ClosedPatches.below is {self.below}, and no patch of "
                f"Game.map has more than {largest} site{'s' if largest > 1 else ''}",
                UserWarning,
                stacklevel=5,
            )


class Arrays(NamedTuple):
    """The patches of a game, one per index of axis P; none without `ClosedPatches`."""

    patch_of: Annotated[Int32, "K"]
    """The patch of each site."""
    sites: Annotated[Int32, "P"]
    """Sites per patch."""
    below: Annotated[Int32, "L"]
    """Of axis L there is one, or none."""
    is_stopped: Annotated[Bool, "L"]
    fine: Annotated[Float64, "L"]
    observed: Annotated[Bool, "L"]
    closed: Annotated[Bool, "B P", DERIVED]
    """Whether the patch is closed in the coming turn."""
    stock: Annotated[Int32, "B P", DERIVED]
    """Apples on each patch."""


def parameters(game: Any) -> dict[str, Any]:
    patch_of = game.patches if with_ballots(game, ClosedPatches) else np.zeros(0, np.int32)
    sites = np.bincount(patch_of)
    return {"patch_of": patch_of, "sites": sites, **columns(ClosedPatches, Arrays, game)}


def is_patch_closed(patches: Arrays, site: int) -> bool:
    """Return whether the patch of a site is closed."""
    return patches.closed[patches.patch_of[site]]


def count_apple(patches: Arrays, site: int, change: int) -> None:
    """Count an apple that has appeared on a site, change 1, or is gone from it, change -1."""
    if patches.sites.shape[0] > 0:
        patches.stock[patches.patch_of[site]] += change


def count_apples(patches: Arrays, stock: UInt8) -> None:
    """Count the apples on each patch; `stock`: uint8 [K]."""
    if patches.sites.shape[0] > 0:
        for p in range(patches.sites.shape[0]):
            patches.stock[p] = 0
        for site in range(stock.shape[0]):
            patches.stock[patches.patch_of[site]] += stock[site]
        close_patches(patches)


def close_patches(patches: Arrays) -> None:
    """Write which patches are closed in the coming turn."""
    for p in range(patches.sites.shape[0]):
        patches.closed[p] = patches.stock[p] < patches.below[0]


def shows_closed(patches: Arrays, site: int) -> bool:
    """Return whether agents see that the patch of a site is closed; -1: where there is no site."""
    if patches.observed.shape[0] == 0 or not patches.observed[0] or site < 0:
        return False
    return is_patch_closed(patches, site)
