"""Mediation: the shooter pays a refund for a tag of an agent that broke no rule."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, NamedTuple

from cprl.institutions.institution import Amount, Institution
from cprl.institutions.ledger import UNJUST_TAGS, Ledger
from cprl.values import Positive
from cprl.values.array_types import Bool, Float64, Int32


@dataclass(frozen=True, kw_only=True)
class Mediation(Institution):
    """A tag of an agent that broke no rule is unjust, and the shooter pays a refund for it.

    This is Ostrom's principle 6, conflict resolution. A tag is unjust if the tagged agent has violated no
    rule in this turn and the `turns` - 1 turns before it. Then each agent that tagged it commits a violation,
    and together they pay `refund` to the tagged agent, whether that is detected or not.

    Agents observe which agents have violated a rule in the last `turns`: the observer first, then the agents
    with the following indices, cyclically. To tell these agents apart they need `Observation.agents_apart`.
    """

    turns: Positive = 10
    """The number of turns, this one included, in which a violation justifies a tag."""

    refund: Amount = 1.0
    """The apples that the tagged agent receives."""

    entries: ClassVar[tuple[str, ...]] = ("violator",)
    most_in_game: ClassVar[int | None] = 1
    needed_switches: ClassVar[tuple[str, ...]] = ("agents_apart",)
    counts: ClassVar[tuple[str, ...]] = ("unjust_tags",)

    @property
    def can_be_broken(self) -> bool:
        return True

    @property
    def needs_tags(self) -> bool:
        return True

    def shown_entries(self, *, number: int, ballot: int, agents: int) -> list[tuple[str, int]]:
        return [("violator", agent) for agent in range(agents)]


class MediationArrays(NamedTuple):
    """The parameters of a game's `Mediation`; axis M has length 1, or 0 without it."""

    turns: Annotated[Int32, "M"]
    refund: Annotated[Float64, "M"]


def mediate(mediation: MediationArrays, ledger: Ledger, tagged_by: Bool, turn: int) -> None:
    """Refund all agents that were tagged unjustly; `tagged_by`: bool [N, N], agent tagged, shooter."""
    if mediation.turns.shape[0] > 0:
        for agent in range(tagged_by.shape[0]):
            refund_tag(mediation, ledger, tagged_by, agent, turn)


def refund_tag(mediation: MediationArrays, ledger: Ledger, tagged_by: Bool, agent: int, turn: int) -> None:
    """Refund an agent if it was tagged and broke no rule, and let the shooters pay in equal parts."""
    shooters = 0
    for shooter in range(tagged_by.shape[0]):
        shooters += tagged_by[agent, shooter]
    if shooters == 0 or ledger.has_violated[agent] or has_mark(mediation, ledger, agent, turn):
        return
    ledger.transfers[agent] += mediation.refund[0]
    for shooter in range(tagged_by.shape[0]):
        if tagged_by[agent, shooter]:
            ledger.fines[shooter] += mediation.refund[0] / shooters
            ledger.counts[shooter, UNJUST_TAGS] += 1
            ledger.has_tagged_unjustly[shooter] = True


def has_mark(mediation: MediationArrays, ledger: Ledger, agent: int, turn: int) -> bool:
    """Return whether an agent violated a rule so few turns before this one that a tag in it is just."""
    return ledger.violation_step[agent] > 0 and turn - ledger.violation_step[agent] < mediation.turns[0]


def show_mark(mediation: MediationArrays, ledger: Ledger, offset: int, observer: int, turn: int) -> float:
    """Return what an observer sees of the agent `offset` indices after it: 1 if that violated a rule in the
    last turns, else 0."""
    agent = (observer + offset) % ledger.fines.shape[0]
    return 1.0 if has_mark(mediation, ledger, agent, turn + 1) else 0.0
