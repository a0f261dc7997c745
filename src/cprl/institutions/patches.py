"""ClosedPatches: a patch is closed while it holds too few apples."""

import warnings
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Final, NamedTuple

import numpy as np

from cprl.institutions.arrays import DERIVED, Bools, Bytes, Ints, Numbers
from cprl.institutions.base import Amount, Limit, columns, with_ballots
from cprl.institutions.ledger import CLOSED_BITES, Ledger
from cprl.values import Natural

COUNT: Final = CLOSED_BITES


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
        """Warns (UserWarning) if no patch ever opens, so that nobody gets an apple."""
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

    patch_of: Annotated[Ints, "K"]
    """The patch of each site."""
    sites: Annotated[Ints, "P"]
    """Sites per patch."""
    below: Annotated[Ints, "L"]
    """Of axis L there is one, or none."""
    is_stopped: Annotated[Bools, "L"]
    fine: Annotated[Numbers, "L"]
    observed: Annotated[Bools, "L"]
    closed: Annotated[Bools, "B P", DERIVED]
    """Whether the patch is closed in the coming turn."""
    stock: Annotated[Ints, "B P", DERIVED]
    """Apples on each patch."""


def parameters(game: Any) -> dict[str, Any]:
    patch_of = game.patches if with_ballots(game, ClosedPatches) else np.zeros(0, np.int32)
    sites = np.bincount(patch_of)
    return {"patch_of": patch_of, "sites": sites, **columns(ClosedPatches, Arrays, game)}


def breaks(patches: Arrays, ledger: Ledger, p: int, i: int, cell: int, site: int, turn: int) -> bool:
    return patches.closed[patches.patch_of[site]]


def note_bite(patches: Arrays, ledger: Ledger, i: int, cell: int, site: int, turn: int) -> None:
    if patches.sites.shape[0] > 0:
        patches.stock[patches.patch_of[site]] -= 1


def note_growth(patches: Arrays, ledger: Ledger, site: int) -> None:
    if patches.sites.shape[0] > 0:
        patches.stock[patches.patch_of[site]] += 1


def refresh(patches: Arrays, ledger: Ledger, stock: Bytes) -> None:
    if patches.sites.shape[0] > 0:
        for p in range(patches.sites.shape[0]):
            patches.stock[p] = 0
        for site in range(stock.shape[0]):
            patches.stock[patches.patch_of[site]] += stock[site]
        close(patches)


def open_turn(patches: Arrays, ledger: Ledger, turn: int, stock_share: float) -> None:
    close(patches)


def close(patches: Arrays) -> None:
    """Writes which patches are closed in the coming turn."""
    for p in range(patches.sites.shape[0]):
        patches.closed[p] = patches.stock[p] < patches.below[0]


def forbids(patches: Arrays, ledger: Ledger, i: int, cell: int, site: int) -> bool:
    if patches.observed.shape[0] == 0 or not patches.observed[0] or site < 0:
        return False
    return patches.closed[patches.patch_of[site]]
