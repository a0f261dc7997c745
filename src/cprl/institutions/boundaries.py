"""Boundaries: regions of the board with owners."""

from dataclasses import dataclass
from string import ascii_lowercase, digits
from typing import Annotated, Any, ClassVar, Final

from cprl.institutions.base import Amount, Institution
from cprl.values import Where, shown

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

    principle: ClassVar[str] = "1 clearly defined boundaries"

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
        """The signs of the regions that an agent may use."""
        if self.owners is not None:
            return self.owners[agent]
        return SIGNS[agent] if agent < len(SIGNS) else ""

    def check_board(self, *, agents: int, height: int, width: int) -> None:
        size = len(self.regions), len(self.regions[0])
        if size != (height, width):
            raise ValueError(
                f"Boundaries.regions is {size[0]} x {size[1]}; allowed: {height} x {width}, as the map"
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
