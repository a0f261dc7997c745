"""Boundaries: regions of the board with owners."""

from dataclasses import dataclass
from string import ascii_lowercase, digits
from typing import Annotated, Any, ClassVar, Final, NamedTuple

import numpy as np

from cprl.institutions.base import Amount, Institution, columns, with_ballots
from cprl.institutions.ledger import OWN_BITES, TRESPASSES, Ledger, violate
from cprl.values import Where, shown
from cprl.values.arrays import Bool, Float64

OPEN: Final = "."
"""The sign of a cell that everybody may use."""
NOBODY: Final = "-"
"""The sign of a cell that nobody may use: a reserve."""
SIGNS: Final = digits + ascii_lowercase
"""The signs of the regions of agents 0, 1, ..., where `owners` is None."""

Regions = Annotated[
    tuple[str, ...],
    Where(
        lambda rows: len({len(row) for row in rows}) == 1 and all(row.isprintable() and row for row in rows),
        "equally long texts, one per row of the board, a sign per cell",
    ),
]
Owners = Annotated[
    tuple[str, ...],
    Where(
        lambda owners: owners and all(OPEN not in signs and NOBODY not in signs for signs in owners),
        "a text per agent: the signs of the regions that it may use",
    ),
]


@dataclass(frozen=True, kw_only=True)
class Boundaries(Institution):
    """Regions of the board belong to agents; others may not harvest there, or pay for it (Ostrom's principle
    1, clearly defined boundaries).

    Agents observe, for each cell of their window, whether a bite there would break a rule.
    """

    regions: Regions
    """The board, a text per row with one sign per cell: "." is open to all, "-" to nobody, any other sign
    names a region."""

    owners: Owners | None = None
    """For each agent the signs of the regions that it may use, e.g. ("a", "a", "ab"). None: agent i may use
    the region of its own sign, 0 to 9, then a to z."""

    bite_fine: Amount | None = None
    """None: nobody can harvest in the region of others. A number: it can be done, is a violation,
    and costs so many apples if it is detected."""

    step_fine: Amount | None = None
    """None: everybody may stand anywhere. A number: each turn that ends in the region of others
    is a violation, and costs so many apples if it is detected."""

    shows_places: ClassVar[bool] = True
    counts: ClassVar[tuple[str, ...]] = ("own_bites", "foreign_bites", "trespasses")

    @classmethod
    def drawn(cls, drawing: str, **fields: Any) -> "Boundaries":
        """Boundaries from a drawing: a line per row, spaces and empty lines around it are ignored."""
        lines = [line.strip() for line in str(drawing).splitlines()]
        return cls(regions=tuple(line for line in lines if line), **fields)

    @classmethod
    def strips(cls, *, height: int, width: int, agents: int, **fields: Any) -> "Boundaries":
        """Return vertical strips of a board, one per agent from left to right, equally wide to a column."""
        if not 1 <= agents <= min(width, len(SIGNS)):
            raise ValueError(f"agents is {agents}; allowed: 1 to {min(width, len(SIGNS))}")
        row = "".join(SIGNS[col * agents // width] for col in range(width))
        return cls(regions=(row,) * height, **fields)

    def signs_of(self, agent: int) -> str:
        """Return the signs of the regions that an agent may use."""
        if self.owners is not None:
            return self.owners[agent]
        return SIGNS[agent] if agent < len(SIGNS) else ""

    @property
    def can_be_broken(self) -> bool:
        return self.bite_fine is not None or self.step_fine is not None

    def may_harvest(self, agent: int, row: int, col: int) -> bool:
        return self.bite_fine is not None or self.regions[row][col] in OPEN + self.signs_of(agent)

    def check(self, game: Any) -> None:
        agents, size = game.agents, (len(self.regions), len(self.regions[0]))
        if size != (game.map.height, game.map.width):
            raise ValueError(
                f"Boundaries.regions is {size[0]} x {size[1]}; allowed: {game.map.height} x "
                f"{game.map.width}, as the map"
            )
        if self.owners is not None and len(self.owners) != agents:
            raise ValueError(
                f"Boundaries.owners has {len(self.owners)} entries; allowed: {agents}, one per agent"
            )
        used = {sign for agent in range(agents) for sign in self.signs_of(agent)}
        for row, line in enumerate(self.regions):
            for col, sign in enumerate(line):
                if sign not in (OPEN, NOBODY) and sign not in used:
                    raise ValueError(
                        f"Boundaries.regions has {shown(sign)} in row {row}, column {col}, which no agent "
                        "may use; allowed: '.', '-' and the signs of owners"
                    )


class Arrays(NamedTuple):
    """All boundaries of a game, one per index of axis R."""

    may_use: Annotated[Bool, "R N cells"]
    """Whether the agent may use the cell; cells as in `cprl.commons.tables.Tables`."""
    is_stopped: Annotated[Bool, "R"]
    fine: Annotated[Float64, "R"]
    step_is_violation: Annotated[Bool, "R"]
    step_fine: Annotated[Float64, "R"]
    observed: Annotated[Bool, "R"]


def parameters(game: Any) -> dict[str, Any]:
    boundaries = [boundary for boundary, _ in with_ballots(game, Boundaries)]
    board, tables = game.map, game.tables
    rows = tables.background.size // tables.stride
    may_use = np.ones((len(boundaries), game.agents, rows, tables.stride), np.bool_)
    inside = slice(tables.rim, tables.rim + board.height), slice(tables.rim, tables.rim + board.width)
    for number, boundary in enumerate(boundaries):
        signs = np.array([list(row) for row in boundary.regions])
        for agent in range(game.agents):
            may_use[(number, agent, *inside)] = np.isin(signs, [OPEN, *boundary.signs_of(agent)])
    return {
        "may_use": may_use.reshape(len(boundaries), game.agents, tables.background.size),
        "is_stopped": [boundary.bite_fine is None for boundary in boundaries],
        "fine": [boundary.bite_fine or 0.0 for boundary in boundaries],
        "step_is_violation": [boundary.step_fine is not None for boundary in boundaries],
        **columns(Boundaries, Arrays, game),
    }


def is_foreign(boundaries: Arrays, r: int, i: int, cell: int) -> bool:
    """Return whether agent i may not use a cell."""
    return not boundaries.may_use[r, i, cell]


def count_own_bites(boundaries: Arrays, ledger: Ledger, i: int, cell: int) -> None:
    """Count a harvest of agent i on a cell that it may use."""
    for r in range(boundaries.fine.shape[0]):
        ledger.counts[i, OWN_BITES] += boundaries.may_use[r, i, cell]


def note_trespass(boundaries: Arrays, ledger: Ledger, i: int, cell: int) -> None:
    """Note that agent i ends its move on a cell that it may not use, if it may not."""
    for r in range(boundaries.step_fine.shape[0]):
        if is_foreign(boundaries, r, i, cell):
            if boundaries.step_is_violation[r]:
                violate(ledger, i, TRESPASSES, boundaries.step_fine[r])
            else:
                ledger.counts[i, TRESPASSES] += 1


def shows_foreign(boundaries: Arrays, i: int, cell: int) -> bool:
    """Return whether agent i sees that it may not use a cell."""
    for r in range(boundaries.observed.shape[0]):
        if boundaries.observed[r] and is_foreign(boundaries, r, i, cell):
            return True
    return False
