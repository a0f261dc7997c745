"""Mediation: tags of agents that broke no rule are refunded."""

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, NamedTuple

from cprl.institutions.base import Amount, Institution, columns
from cprl.institutions.ledger import UNJUST_TAGS, Ledger
from cprl.values import Positive
from cprl.values.arrays import Bool, Float64, Int32


@dataclass(frozen=True, kw_only=True)
class Mediation(Institution):
    """A tag of an agent that broke no rule is unjust, and refunded by the shooter (Ostrom's principle 6,
    conflict resolution).

    A tag is unjust if the tagged agent has violated no rule in this turn and the `turns` - 1 before it. It is
    a violation by each agent that tagged; together they pay `refund` to the tagged one, detected or not.
    Agents observe which agents have violated a rule in the last `turns`, their own mark first, then those of
    the following indices, cyclically; to know them apart they need `Observation.agents_apart`.
    """

    turns: Positive = 10
    """The number of turns, this one included, in which a violation justifies a tag."""

    refund: Amount = 1.0
    """The apples that the tagged agent is paid."""

    entries: ClassVar[tuple[str, ...]] = ("violator",)
    at_most: ClassVar[int | None] = 1
    needs: ClassVar[tuple[str, ...]] = ("agents_apart",)
    counts: ClassVar[tuple[str, ...]] = ("unjust_tags",)

    @property
    def can_be_broken(self) -> bool:
        return True

    @property
    def needs_tags(self) -> bool:
        return True

    def shows(self, *, number: int, ballot: int, agents: int) -> list[tuple[str, int]]:
        return [("violator", agent) for agent in range(agents)]


class Arrays(NamedTuple):
    """The mediation of a game: of axis M there is one, or none."""

    turns: Annotated[Int32, "M"]
    refund: Annotated[Float64, "M"]


def parameters(game: Any) -> dict[str, Any]:
    return columns(Mediation, Arrays, game)


def mediate(mediation: Arrays, ledger: Ledger, tagged_by: Bool, turn: int) -> None:
    """Refund agents that were tagged but broke no rule in the last turns; `tagged_by`: bool [N, N]."""
    if mediation.turns.shape[0] > 0:
        for i in range(tagged_by.shape[0]):
            refund_tag(mediation, ledger, tagged_by, i, turn)


def refund_tag(mediation: Arrays, ledger: Ledger, tagged_by: Bool, i: int, turn: int) -> None:
    """Refund agent i for a tag, if there was any and it was unjust."""
    shooters = 0
    for j in range(tagged_by.shape[0]):
        shooters += tagged_by[i, j]
    if shooters == 0 or ledger.broke[i] or has_mark(mediation, ledger, i, turn):
        return
    ledger.transfers[i] += mediation.refund[0]
    for j in range(tagged_by.shape[0]):
        if tagged_by[i, j]:
            ledger.fines[j] += mediation.refund[0] / shooters
            ledger.counts[j, UNJUST_TAGS] += 1
            ledger.unjust[j] = True


def has_mark(mediation: Arrays, ledger: Ledger, i: int, turn: int) -> bool:
    """Return whether agent i violated a rule in the turns before this one that justify a tag in it."""
    return ledger.violation_step[i] > 0 and turn - ledger.violation_step[i] < mediation.turns[0]


def show_mark(mediation: Arrays, ledger: Ledger, offset: int, i: int, turn: int) -> float:
    """1 if the agent so many indices after i violated a rule in the last turns."""
    agent = (i + offset) % ledger.fines.shape[0]
    return 1.0 if has_mark(mediation, ledger, agent, turn + 1) else 0.0
