"""equilibria: the Nash equilibria of a game of two agents, by nashpy (the extra "theory")."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from cprl import arguments
from cprl.theory.extras import extra
from cprl.theory.payoff_table import PayoffTable, Values

MOST_STRATEGIES: Final = 6
"""With more, nashpy takes minutes."""
_SAME: Final = 1e-6
"""Shares that differ by less are the same."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Equilibrium:
    """What two agents play, so that neither gains if it alone plays anything else."""

    first: Values
    """float64 [S], the shares of the strategies that one agent plays."""
    second: Values
    """float64 [S], those of the other."""

    @property
    def is_symmetric(self) -> bool:
        """Whether both play the same."""
        return bool(np.allclose(self.first, self.second, atol=_SAME))

    @property
    def support(self) -> tuple[int, ...]:
        """The strategies that an agent plays, ascending."""
        return tuple(np.flatnonzero((self.first > _SAME) | (self.second > _SAME)).tolist())


def equilibria(table: PayoffTable) -> tuple[Equilibrium, ...]:
    """The equilibria of a symmetric game of two agents, by nashpy's enumeration of vertices.

    They are all of them, unless the game is degenerate: where strategies are equally good, there may be
    infinitely many, and these are the corners. An equilibrium in which the agents play differently is there
    once, not once for either agent.

    Args:
        table: of two agents and up to 6 strategies; of a game of more agents its `reduced`.

    Raises:
        ValueError: for other tables.
        ModuleNotFoundError: if nashpy is not installed.
    """
    arguments.object_of("table", table, PayoffTable, "a PayoffTable")
    if table.agents != 2:
        raise ValueError(f"table is of {table.agents} agents; allowed: 2, e.g. table.reduced")
    if table.strategies > MOST_STRATEGIES:
        raise ValueError(f"table has {table.strategies} strategies; allowed: at most {MOST_STRATEGIES}")
    nashpy = extra("nashpy")
    own = table.normalised.pairs + 1.0  # above 0, or the polytopes have no end
    found: dict[tuple[float, ...], Equilibrium] = {}
    for first, second in nashpy.Game(own, own.T).vertex_enumeration():
        sides = sorted((tuple(np.round(side, 6) + 0.0) for side in (first, second)), reverse=True)
        key = (*sides[0], *sides[1])
        found.setdefault(key, Equilibrium(first=np.array(sides[0]), second=np.array(sides[1])))
    return tuple(found[key] for key in sorted(found, reverse=True))
