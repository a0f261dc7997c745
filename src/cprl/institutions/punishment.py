"""Punishment: agents may fine each other, at a cost of their own."""

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, NamedTuple

from cprl.institutions.base import Amount, Institution, columns
from cprl.institutions.ledger import Ledger
from cprl.values.arrays import Bool, Float64


@dataclass(frozen=True, kw_only=True)
class Punishment(Institution):
    """Whoever tags another agent fines it, and pays for that (costly punishment: E. Fehr and S. Gächter,
    "Cooperation and punishment in public goods experiments", 2000).

    An agent that several tag at once pays for each of them. Fines go to nobody. With `Rules.freeze_steps` of
    0 the tagged agent misses no turn and stays in the windows of others, and under `respawn_at_spawns` it
    goes on at a spawn place, as soon as one is free. Agents observe nothing of it.
    """

    fine: Amount = 2.0
    """The apples that a tag takes from the tagged agent."""

    cost: Amount = 1.0
    """The apples that a tag costs the agent that tags."""

    shot_cost: Amount = 0.0
    """The apples that a shot costs, whether it tags or not."""

    at_most: ClassVar[int | None] = 1

    @property
    def needs_tags(self) -> bool:
        return True


class Arrays(NamedTuple):
    """The punishment of a game: of axis P there is one, or none."""

    fine: Annotated[Float64, "P"]
    cost: Annotated[Float64, "P"]
    shot_cost: Annotated[Float64, "P"]


def parameters(game: Any) -> dict[str, Any]:
    return columns(Punishment, Arrays, game)


def punish(punishment: Arrays, ledger: Ledger, tagged_by: Bool, fired: Bool) -> None:
    """Fine tagged agents, and whoever fired and tagged them; `tagged_by`: bool [N, N], `fired`: bool [N]."""
    if punishment.fine.shape[0] == 0:
        return
    for i in range(tagged_by.shape[0]):
        if fired[i]:
            ledger.fines[i] += punishment.shot_cost[0]
        for j in range(tagged_by.shape[0]):
            if tagged_by[i, j]:
                ledger.fines[i] += punishment.fine[0]
                ledger.fines[j] += punishment.cost[0]
