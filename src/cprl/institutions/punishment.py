"""Punishment: a tag fines the tagged agent, and costs the agent that tags."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, NamedTuple

from cprl.institutions.institution import Amount, Institution
from cprl.institutions.ledger import Ledger
from cprl.values.array_types import Bool, Float64


@dataclass(frozen=True, kw_only=True)
class Punishment(Institution):
    """An agent that tags another one fines it, and pays for doing so.

    This is costly punishment (E. Fehr and S. Gächter, "Cooperation and punishment in public goods
    experiments", 2000). An agent that several agents tag at once pays a fine for each of them. The fines go
    to nobody. Agents observe nothing of this institution.

    With `Rules.freeze_steps` of 0 a tagged agent misses no turn and stays in the windows of others. Under
    `Rules.respawn_at_spawns` it goes on at a spawn place as soon as one is free.
    """

    fine: Amount = 2.0
    """The apples that a tag takes from the tagged agent."""

    cost: Amount = 1.0
    """The apples that a tag costs the shooter."""

    shot_cost: Amount = 0.0
    """The apples that each shot costs the shooter, whether it tags or not."""

    most_in_game: ClassVar[int | None] = 1

    @property
    def needs_tags(self) -> bool:
        return True


class PunishmentArrays(NamedTuple):
    """The parameters of a game's `Punishment`; axis P has length 1, or 0 without it."""

    fine: Annotated[Float64, "P"]
    cost: Annotated[Float64, "P"]
    shot_cost: Annotated[Float64, "P"]


def punish(punishment: PunishmentArrays, ledger: Ledger, tagged_by: Bool, fired: Bool) -> None:
    """Fine tagged agents, and charge agents for their tags and shots.

    `tagged_by`: bool [N, N], agent tagged, shooter; `fired`: bool [N].
    """
    if punishment.fine.shape[0] == 0:
        return
    for agent in range(tagged_by.shape[0]):
        if fired[agent]:
            ledger.fines[agent] += punishment.shot_cost[0]
        for shooter in range(tagged_by.shape[0]):
            if tagged_by[agent, shooter]:
                ledger.fines[agent] += punishment.fine[0]
                ledger.fines[shooter] += punishment.cost[0]
