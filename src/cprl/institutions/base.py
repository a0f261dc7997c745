"""What all institutions share."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Annotated, ClassVar, Final

from cprl.values import Range, Value

MOST_INSTITUTIONS: Final = 64
"""The largest number of institutions of a game."""

MOST_APPLES: Final = 1e6
"""The largest amount that an institution takes or gives at once."""

Amount = Annotated[float, Range(0, MOST_APPLES)]
"""Apples."""


@dataclass(frozen=True, kw_only=True)
class Institution(Value, stored=False):
    """A rule that people make, as a value that a game carries: `Game(..., institutions=(Quota(), Tax()))`.

    Institutions act inside the turn, see `docs/institutions.md`. Amounts are in apples.
    """

    observed: bool = True
    """Whether agents observe what this institution shows them, see `cprl.commons.views`."""

    principle: ClassVar[str] = ""
    """Of the eight design principles of Ostrom, "Governing the Commons" (1990), table 3.1."""
    at_most: ClassVar[int | None] = None
    """How many of this kind a game can have; None for any number."""
    needs: ClassVar[tuple[str, ...]] = ()
    """The switches of `Observation` without which agents cannot use what this institution shows them."""

    def check_board(self, *, agents: int, height: int, width: int) -> None:
        """Checks that it fits a board with N agents."""


def check_agent_indices(name: str, indices: Sequence[int], agents: int) -> None:
    """Checks that all indices are of agents of the game."""
    for agent in indices:
        if agent >= agents:
            raise ValueError(f"{name} has agent {agent}; allowed on this map: 0 to {agents - 1}")


OF_ELECTIONS: Final = ("period_episodes", "override_prob")
"""The fields that say how an election is held."""


def check_no_election(institution: Institution, elects: str) -> None:
    """Checks that an institution without an election says nothing about how one is held.

    Args:
        elects: what it would have to be for an election, in words.
    """
    for field in fields(institution):
        if field.name in OF_ELECTIONS and (value := getattr(institution, field.name)) != field.default:
            raise ValueError(
                f"{type(institution).__name__}.{field.name} is {value!r} and nobody is elected; allowed: "
                f"{field.default!r}, or others where {elects}"
            )
