"""Institution: the base class of all institutions, their ballots, and helpers that modules share."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, NamedTuple, TypeVar

from cprl.values import Range, Value

MOST_APPLES: Final = 1e6
"""The largest amount that an institution takes or gives at once."""

Amount = Annotated[float, Range(0, MOST_APPLES)]
"""A number of apples."""

A_RULE_TO_BREAK: Final = "a Boundaries, Quota or the like with a fine, or a Mediation, beside it"
"""The institutions that have violations, for messages of those that need some."""


class Ballot(NamedTuple):
    """A question that agents decide together, e.g. the rate of a tax."""

    title: str
    """The thing to decide, in words."""
    choices: tuple[float, ...]
    """The values to choose from; in an election the indices of agents."""
    is_election: bool = False
    """Whether the choice with most votes wins; otherwise the median of the decisions does."""
    period_episodes: int = 0
    """The ballot is held at the first of every such number of episodes; 0 for what a governor sets, on which
    no agent votes."""
    override_prob: float = 0.0
    """The probability that the result is drawn by chance, whatever agents decide."""


@dataclass(frozen=True, kw_only=True)
class Institution(Value, stored=False):
    """The base class of rules that people make: values that a game carries in `Game.institutions`.

    `docs/institutions.md` describes how institutions act in a turn. All amounts are in apples. Methods that
    take a game get the `cprl.Game` that carries the institution.
    """

    observed: bool = True
    """Whether agents observe the entries and places that this institution can show them, see
    `cprl.commons.views`."""

    most_in_game: ClassVar[int | None] = None
    """The largest number of institutions of this kind in a game; None for any number."""
    needed_switches: ClassVar[tuple[str, ...]] = ()
    """The switches of `Observation` that must be on for agents to understand what this institution shows."""
    shows_places: ClassVar[bool] = False
    """Whether it shows agents the cells where they may not harvest."""
    entries: ClassVar[tuple[str, ...]] = ()
    """The names of the numbers that it shows agents; the `show_...` rule of its module computes them, by the
    index of the name."""
    counts: ClassVar[tuple[str, ...]] = ()
    """The names in `cprl.institutions.COUNT_NAMES` that it counts, besides violations."""
    voted_on: ClassVar[str] = ""
    """The number of it that agents can vote on, or a governor sets, in words; "" for none."""

    @property
    def rule(self) -> "Institution":
        """Return the institution that acts: this one, or for a `Vote` the one that is voted on."""
        return self

    @property
    def can_be_broken(self) -> bool:
        """Return whether agents can break it, so that there are violations."""
        return False

    @property
    def needs_tags(self) -> bool:
        """Return whether it has no effect in a game in which nobody may fire."""
        return False

    def ballot(self, agents: int) -> Ballot | None:
        """Return the ballot by which N agents decide about it; None if they do not."""
        return None

    def shown_entries(self, *, number: int, ballot: int, agents: int) -> list[tuple[str, int]]:
        """Return the (entry, argument) pairs that it shows agents, with entries out of `entries`.

        Args:
            number: its index among the game's institutions of its kind, the argument by default.
            ballot: the index in `Game.in_force` of what is decided about it, or -1.
            agents: the number of agents N.
        """
        return [(entry, number) for entry in self.entries]

    def check_choices(self, name: str, choices: Sequence[float]) -> None:
        """Raise a ValueError if a choice is no value of the number that is `voted_on`; `name` stands for the
        field with the choices, in ascending order."""

    def may_harvest(self, agent: int, row: int, col: int) -> bool:
        """Return whether it lets an agent ever harvest on a cell."""
        return True

    def check(self, game: Any) -> None:
        """Raise a ValueError for a game that it does not fit."""


@dataclass(frozen=True, kw_only=True)
class Limit(Institution, stored=False):
    """The base class of rules that limit where, when or how much agents may harvest.

    Each has a last field `fine`: the apples that a harvest against the rule costs if it is detected, or None
    if such a harvest is impossible.
    """

    if TYPE_CHECKING:
        fine: Amount | None

    @property
    def is_stopped(self) -> bool:
        """Return whether harvests against the rule are impossible."""
        return self.fine is None

    @property
    def can_be_broken(self) -> bool:
        return not self.is_stopped


Kind = TypeVar("Kind", bound=Institution)


def with_ballots(game: Any, kind: type[Kind]) -> list[tuple[Kind, int]]:
    """Return the institutions of a kind in a game, each with the index in `Game.in_force` of what is decided
    about it, or -1.

    An institution that is voted on counts as one of its kind.
    """
    return [
        (institution.rule, ballot)
        for institution, ballot in with_ballot_index(game)
        if isinstance(institution.rule, kind)
    ]


def field_values(kind: type[Kind], arrays: Any, game: Any) -> dict[str, Any]:
    """Return the parameters that a module takes from the fields of its institutions.

    Each entry of `arrays`, the class of the module's arrays, that is named like a field of `kind` gets a list
    with the value of that field in each institution of the game, 0 for None. The entry "ballot" gets the
    indices of their ballots, or -1.
    """
    rules = with_ballots(game, kind)
    entries = {"ballot": [ballot for _, ballot in rules]}
    for name in arrays._fields:
        if name != "ballot" and hasattr(kind, name):
            entries[name] = [getattr(rule, name) or 0 for rule, _ in rules]
    return entries


def with_ballot_index(game: Any) -> Iterator[tuple[Institution, int]]:
    """Yield the institutions of a game, each with the index in `Game.in_force` of what is decided about it,
    or -1. What a governor sets comes after all ballots."""
    ballots = 0
    governor = game.governor
    last = () if governor is None else (governor, governor.governed(game))
    for institution in game.institutions:
        if any(institution is each for each in last):
            yield institution, len(game.ballots)
        elif institution.ballot(game.agents):
            yield institution, ballots
            ballots += 1
        else:
            yield institution, -1


def threshold(prob: float) -> int:
    """Return the threshold below which a uniform 32-bit word lies with a probability, to within 2**-33."""
    return round(prob * 2**32)


def check_agent_indices(name: str, indices: Sequence[int], agents: int) -> None:
    """Raise a ValueError for an index that no agent of the game has; `name` stands for the field."""
    for agent in indices:
        if agent >= agents:
            raise ValueError(f"{name} has agent {agent}; allowed on this map: 0 to {agents - 1}")


ELECTION_FIELDS: Final = ("period_episodes", "override_prob")
"""The fields of an institution that say how an election is held."""


def check_no_election(institution: Institution, elects: str) -> None:
    """Raise a ValueError if an institution that holds no election has settings about an election.

    Args:
        institution: the institution.
        elects: the condition under which it would hold an election, in words, for the message.
    """
    kind = type(institution)
    for name in ELECTION_FIELDS:
        value = getattr(institution, name, None)
        default = getattr(kind, name, None)
        if value != default:
            raise ValueError(
                f"{kind.__name__}.{name} is {value!r} and nobody is elected; allowed: {default!r}, or others "
                f"where {elects}"
            )
