"""ClosedPatches: nobody may harvest a patch of sites while it holds too few apples."""

import warnings
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np

from cprl.institutions.arrays import DERIVED
from cprl.institutions.institution import Amount, Limit, field_values, with_ballots
from cprl.values import Natural
from cprl.values.array_types import Bool, Float64, Int32, UInt8


@dataclass(frozen=True, kw_only=True)
class ClosedPatches(Limit):
    """A patch of sites is closed for harvests while it holds too few apples.

    This is Ostrom's principle 2, rules that fit local conditions. Two sites belong to one patch if they are
    near each other (`Rules.regrow_radius_cells`), directly or through other sites. A patch is closed in every
    turn that begins with fewer than `below` apples on it. Agents observe for each cell of their window
    whether a harvest there would break a rule.
    """

    below: Natural = 2
    """The number of apples below which a patch is closed."""

    fine: Amount | None = None
    """The fine in apples for each harvest in a closed patch, which is a violation, if it is detected. None
    makes such harvests impossible."""

    most_in_game: ClassVar[int | None] = 1
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


class PatchArrays(NamedTuple):
    """The patches of a game, on axis P; there are none in a game without `ClosedPatches`."""

    patch_of: Annotated[Int32, "K"]
    """The index of each site's patch."""
    sites: Annotated[Int32, "P"]
    """The number of sites in each patch."""
    below: Annotated[Int32, "L"]
    """The number of apples below which a patch is closed; axis L has length 1, or 0 without the
    institution."""
    is_stopped: Annotated[Bool, "L"]
    fine: Annotated[Float64, "L"]
    observed: Annotated[Bool, "L"]
    is_closed: Annotated[Bool, "B P", DERIVED]
    """True for patches that are closed in the coming turn."""
    stock: Annotated[Int32, "B P", DERIVED]
    """The number of apples on each patch."""


def parameters(game: Any) -> dict[str, Any]:
    """Return the parameters in `PatchArrays` by name."""
    patch_of = game.patches if with_ballots(game, ClosedPatches) else np.zeros(0, np.int32)
    sites = np.bincount(patch_of)
    return {"patch_of": patch_of, "sites": sites, **field_values(ClosedPatches, PatchArrays, game)}


def is_patch_closed(patches: PatchArrays, site: int) -> bool:
    """Return whether the patch of a site is closed."""
    return patches.is_closed[patches.patch_of[site]]


def count_apple(patches: PatchArrays, site: int, change: int) -> None:
    """Update the apples of a patch: an apple has appeared on a site (`change` 1) or gone (`change` -1)."""
    if patches.sites.shape[0] > 0:
        patches.stock[patches.patch_of[site]] += change


def count_apples(patches: PatchArrays, stock: UInt8) -> None:
    """Count the apples on each patch, and close patches accordingly; `stock`: uint8 [K]."""
    if patches.sites.shape[0] > 0:
        for patch in range(patches.sites.shape[0]):
            patches.stock[patch] = 0
        for site in range(stock.shape[0]):
            patches.stock[patches.patch_of[site]] += stock[site]
        close_patches(patches)


def close_patches(patches: PatchArrays) -> None:
    """Close the patches that hold too few apples for the coming turn, and open all others."""
    for patch in range(patches.sites.shape[0]):
        patches.is_closed[patch] = patches.stock[patch] < patches.below[0]


def is_seen_as_closed(patches: PatchArrays, site: int) -> bool:
    """Return whether agents observe that the patch of a site is closed; `site`: -1 for a cell without one."""
    if patches.observed.shape[0] == 0 or not patches.observed[0] or site < 0:
        return False
    return is_patch_closed(patches, site)
