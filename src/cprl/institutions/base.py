"""What all institutions share."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, NamedTuple, TypeVar

from cprl.values import Range, Value

MOST_APPLES: Final = 1e6
"""The largest amount that an institution takes or gives at once."""

Amount = Annotated[float, Range(0, MOST_APPLES)]
"""Apples."""

A_RULE_TO_BREAK: Final = "a Boundaries, Quota or the like with a fine, or a Mediation, beside it"


class Ballot(NamedTuple):
    """One thing that agents decide on."""

    title: str
    """What it is, in words."""
    choices: tuple[float, ...]
    """The values to choose from; agent indices in an election."""
    is_election: bool
    """Whether most votes count rather than the median."""
    period_episodes: int
    override_prob: float


@dataclass(frozen=True, kw_only=True)
class Institution(Value, stored=False):
    """A rule that people make, as a value that a game carries: `Game(..., institutions=(Quota(), Tax()))`.

    Institutions act inside the turn, see `docs/institutions.md`. Amounts are in apples. Where a method gets a
    game, it is the `cprl.Game` that carries the institution.
    """

    observed: bool = True
    """Whether agents observe what this institution shows them, see `cprl.commons.views`."""

    at_most: ClassVar[int | None] = None
    """How many of this kind a game can have; None for any number."""
    needs: ClassVar[tuple[str, ...]] = ()
    """The switches of `Observation` without which agents cannot use what this institution shows them."""
    shows_places: ClassVar[bool] = False
    """Whether it shows agents where bites are forbidden."""
    entries: ClassVar[tuple[str, ...]] = ()
    """What else it shows agents; `shown` of its module gets the index of these names."""
    counts: ClassVar[tuple[str, ...]] = ()
    """Which of `cprl.institutions.COUNTS` it counts, beside violations."""

    @property
    def rule(self) -> "Institution":
        """The institution whose rules hold: itself, or what is voted on."""
        return self

    @property
    def can_be_broken(self) -> bool:
        """Whether it is a rule that agents can break."""
        return False

    @property
    def needs_tags(self) -> bool:
        """Whether it does nothing in a game in which nobody may fire."""
        return False

    def ballot(self, agents: int) -> Ballot | None:
        """Return what N agents decide about it, if they do."""
        return None

    def shows(self, *, number: int, ballot: int, agents: int) -> list[tuple[str, int]]:
        """Return what it shows agents, of its `entries`, each with the number of which one: by default its
        own among those of its kind. `ballot`: the number of its ballot, or of the next one."""
        return [(entry, number) for entry in self.entries]

    def may_harvest(self, agent: int, row: int, col: int) -> bool:
        """Return whether an agent can ever harvest a cell."""
        return True

    def check(self, game: Any) -> None:
        """Refuse a game in which it has no meaning."""


@dataclass(frozen=True, kw_only=True)
class Limit(Institution, stored=False):
    """A rule about who may harvest where, when or how much; `fine` is the last field of each."""

    if TYPE_CHECKING:
        fine: Amount | None

    @property
    def is_stopped(self) -> bool:
        """Whether a bite that breaks the rule does not happen."""
        return self.fine is None

    @property
    def can_be_broken(self) -> bool:
        return not self.is_stopped


Kind = TypeVar("Kind", bound=Institution)


def with_ballots(game: Any, kind: type[Kind]) -> list[tuple[Kind, int]]:
    """Return the institutions of a kind in a game, voted on or not, each with the number of its ballot, or
    -1."""
    return [
        (institution.rule, ballot if institution.ballot(game.agents) else -1)
        for institution, ballot in numbered(game)
        if isinstance(institution.rule, kind)
    ]


def columns(kind: type[Kind], arrays: Any, game: Any) -> dict[str, Any]:
    """Return the parameters in `Arrays` that are named like fields of a kind, by institution in a game, 0 for
    None; `ballot` is the number of its ballot, or -1."""
    rules = with_ballots(game, kind)
    names = [name for name in arrays._fields if name != "ballot" and hasattr(kind, name)]
    return {
        "ballot": [ballot for _, ballot in rules],
        **{name: [getattr(rule, name) or 0 for rule, _ in rules] for name in names},
    }


def numbered(game: Any) -> Iterator[tuple[Institution, int]]:
    """Yield the institutions of a game, each with the number of ballots before it."""
    ballots = 0
    for institution in game.institutions:
        yield institution, ballots
        ballots += institution.ballot(game.agents) is not None


def threshold(prob: float) -> int:
    """Return the threshold below which a uniform 32-bit word falls with this probability, to within
    2**-33."""
    return round(prob * 2**32)


def check_agent_indices(name: str, indices: Sequence[int], agents: int) -> None:
    """Check that all indices are of agents of the game."""
    for agent in indices:
        if agent >= agents:
            raise ValueError(f"{name} has agent {agent}; allowed on this map: 0 to {agents - 1}")


OF_ELECTIONS: Final = ("period_episodes", "override_prob")
"""The fields that say how an election is held."""


def check_no_election(institution: Institution, elects: str) -> None:
    """Check that an institution without an election says nothing about how one is held.

    Args:
        elects: what it would have to be for an election, in words.
    """
    for field in fields(institution):
        if field.name in OF_ELECTIONS and (value := getattr(institution, field.name)) != field.default:
            raise ValueError(
                f"{type(institution).__name__}.{field.name} is {value!r} and nobody is elected; allowed: "
                f"{field.default!r}, or others where {elects}"
            )
