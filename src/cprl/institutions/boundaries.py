"""Boundaries: regions of the board with owners."""

from collections.abc import Sequence
from dataclasses import dataclass
from string import ascii_lowercase, digits
from typing import Annotated, Any, ClassVar, Final, NamedTuple

import numpy as np

from cprl.institutions.institution import Amount, Institution, field_values, with_ballots
from cprl.institutions.ledger import OWN_BITES, TRESPASSES, Ledger, note_violation
from cprl.values import Where, short_repr
from cprl.values.array_types import Bool, Float64

OPEN: Final = "."
"""The sign of a cell that everybody may use."""
NOBODY: Final = "-"
"""The sign of a cell that nobody may use: a reserve."""
AGENT_SIGNS: Final = digits + ascii_lowercase
"""The signs of the regions of agents 0, 1, and so on, where `owners` is None."""

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
    """Regions of the board belong to agents, and other agents may not harvest there, or have to pay for it.

    This is Ostrom's principle 1, clearly defined boundaries. Agents observe for each cell of their window
    whether a harvest there would break a rule.
    """

    regions: Regions
    """The board as one text per row with one sign per cell: "." is open to all agents, "-" to nobody, and any
    other sign names a region."""

    owners: Owners | None = None
    """The signs of the regions that each agent may use, e.g. ("a", "a", "ab") for three agents: each sign of
    a text is a region. None lets agent i use the region of its own sign: "0" to "9", then "a" to "z"."""

    bite_fine: Amount | None = None
    """The fine in apples for a harvest (a bite) in a region of others, which is a violation, if it is
    detected. None makes such a harvest impossible."""

    step_fine: Amount | None = None
    """The fine in apples for a turn that ends in a region of others, which is a violation, if it is detected.
    None lets everybody stand anywhere."""

    shows_places: ClassVar[bool] = True
    counts: ClassVar[tuple[str, ...]] = ("own_bites", "foreign_bites", "trespasses")

    @classmethod
    def drawn(cls, drawing: str, **fields: Any) -> "Boundaries":
        """Return boundaries from a drawing, with a line for each row of the board.

        Args:
            drawing: the text; spaces around lines and empty lines are ignored.
            fields: the other fields, e.g. `bite_fine=1.0`.

        Raises:
            ValueError: for lines of different lengths, or fields that `Boundaries` refuses.
        """
        lines = [line.strip() for line in str(drawing).splitlines()]
        return cls(regions=tuple(line for line in lines if line), **fields)

    @classmethod
    def strips(cls, *, height: int, width: int, agents: int, **fields: Any) -> "Boundaries":
        """Return a board's division into vertical strips, one per agent from left to right.

        The widths of the strips differ by at most one column.

        Args:
            height: the number of rows H of the board.
            width: the number of columns W of the board.
            agents: the number of agents N.
            fields: the other fields.

        Raises:
            ValueError: for more agents than columns or signs, or fields that `Boundaries` refuses.
        """
        if not 1 <= agents <= min(width, len(AGENT_SIGNS)):
            raise ValueError(f"agents is {agents}; allowed: 1 to {min(width, len(AGENT_SIGNS))}")
        row = "".join(AGENT_SIGNS[col * agents // width] for col in range(width))
        return cls(regions=(row,) * height, **fields)

    def signs_of(self, agent: int) -> str:
        """Return the signs of the regions that an agent may use."""
        if self.owners is not None:
            return self.owners[agent]
        return AGENT_SIGNS[agent] if agent < len(AGENT_SIGNS) else ""

    @property
    def can_be_broken(self) -> bool:
        return self.bite_fine is not None or self.step_fine is not None

    def may_harvest(self, agent: int, row: int, col: int) -> bool:
        return self.bite_fine is not None or self.regions[row][col] in OPEN + self.signs_of(agent)

    def check(self, game: Any) -> None:
        height = len(self.regions)
        width = len(self.regions[0])
        if (height, width) != (game.map.height, game.map.width):
            raise ValueError(
                f"Boundaries.regions is {height} x {width}; allowed: {game.map.height} x "
                f"{game.map.width}, as the map"
            )
        if self.owners is not None and len(self.owners) != game.agents:
            raise ValueError(
                f"Boundaries.owners has {len(self.owners)} entries; allowed: {game.agents}, one per agent"
            )
        self._check_signs(game.agents)

    def _check_signs(self, agents: int) -> None:
        """Refuse a sign of a region that no agent may use."""
        known_signs = {sign for agent in range(agents) for sign in self.signs_of(agent)}
        for row, line in enumerate(self.regions):
            for col, sign in enumerate(line):
                if sign not in (OPEN, NOBODY) and sign not in known_signs:
                    raise ValueError(
                        f"Boundaries.regions has {short_repr(sign)} in row {row}, column {col}, which no "
                        "agent may use; allowed: '.', '-' and the signs of owners"
                    )


class BoundaryArrays(NamedTuple):
    """The parameters of all `Boundaries` of a game, one of them per index of axis R."""

    may_use: Annotated[Bool, "R N cells"]
    """True where the agent may use the cell; cells as in `cprl.commons.tables.Tables`."""
    is_stopped: Annotated[Bool, "R"]
    """True if harvests in regions of others are impossible."""
    fine: Annotated[Float64, "R"]
    """`Boundaries.bite_fine`, 0 for None; the name is that of `cprl.institutions.hooks.Limits`."""
    step_is_violation: Annotated[Bool, "R"]
    step_fine: Annotated[Float64, "R"]
    observed: Annotated[Bool, "R"]


def parameters(game: Any) -> dict[str, Any]:
    """Return the parameters in `BoundaryArrays` by name."""
    boundaries = [boundary for boundary, _ in with_ballots(game, Boundaries)]
    return {
        "may_use": _may_use(boundaries, game),
        "is_stopped": [boundary.bite_fine is None for boundary in boundaries],
        "fine": [boundary.bite_fine or 0.0 for boundary in boundaries],
        "step_is_violation": [boundary.step_fine is not None for boundary in boundaries],
        **field_values(Boundaries, BoundaryArrays, game),
    }


def _may_use(boundaries: Sequence[Boundaries], game: Any) -> Bool:
    """Return the cells that each agent may use, bool [R, N, cells]."""
    tables = game.tables
    rows = tables.background.size // tables.stride
    may_use = np.ones((len(boundaries), game.agents, rows, tables.stride), np.bool_)
    # Cells are those of the board and of a rim of walls around it. Nobody harvests there, so it stays True.
    on_board = may_use[:, :, tables.rim : -tables.rim, tables.rim : -tables.rim]
    for rule, boundary in enumerate(boundaries):
        signs = np.array([list(row) for row in boundary.regions])
        for agent in range(game.agents):
            on_board[rule, agent] = np.isin(signs, [OPEN, *boundary.signs_of(agent)])
    return may_use.reshape(len(boundaries), game.agents, tables.background.size)


def is_foreign(boundaries: BoundaryArrays, rule: int, agent: int, cell: int) -> bool:
    """Return whether a cell is in a region of others for an agent; `rule`: the index of the `Boundaries`."""
    return not boundaries.may_use[rule, agent, cell]


def count_own_harvest(boundaries: BoundaryArrays, ledger: Ledger, agent: int, cell: int) -> None:
    """Count a harvest of an agent once for each of the `Boundaries` by which it may use the cell."""
    for rule in range(boundaries.fine.shape[0]):
        ledger.counts[agent, OWN_BITES] += boundaries.may_use[rule, agent, cell]


def note_trespass(boundaries: BoundaryArrays, ledger: Ledger, agent: int, cell: int) -> None:
    """Count a trespass of an agent if it ends its move in a region of others; it may be a violation."""
    for rule in range(boundaries.step_fine.shape[0]):
        if is_foreign(boundaries, rule, agent, cell):
            if boundaries.step_is_violation[rule]:
                note_violation(ledger, agent, TRESPASSES, boundaries.step_fine[rule])
            else:
                ledger.counts[agent, TRESPASSES] += 1


def is_seen_as_foreign(boundaries: BoundaryArrays, agent: int, cell: int) -> bool:
    """Return whether agents observe that an agent may not use a cell."""
    for rule in range(boundaries.observed.shape[0]):
        if boundaries.observed[rule] and is_foreign(boundaries, rule, agent, cell):
            return True
    return False
