"""Sanctioner: only some agents may fire."""

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, NamedTuple

from cprl.institutions.arrays import DERIVED
from cprl.institutions.base import Ballot, Institution, check_agent_indices, check_no_election, with_ballots
from cprl.institutions.ledger import Ledger
from cprl.values import AgentIndices, Positive, Share
from cprl.values.arrays import Bool


@dataclass(frozen=True, kw_only=True)
class Sanctioner(Institution):
    """Only some agents may fire: named ones, or the one that all elect (Ostrom's principle 7, the right to
    organise).

    In an election each agent's decision is the index of an agent; most votes win, ties are drawn by the
    game's chance. Agents observe whether they may fire.
    """

    agents: AgentIndices | None = None
    """The agents that may fire; None for an election."""

    period_episodes: Positive = 1
    """An election is held in every such number of episodes, from the first one."""

    override_prob: Share = 0.0
    """The probability that an authority from outside appoints an agent by chance, all equally likely, in
    place of the elected one."""

    entries: ClassVar[tuple[str, ...]] = ("may fire",)
    at_most: ClassVar[int | None] = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.agents is not None:
            check_no_election(self, "agents is None, so that they are elected")

    @property
    def needs_tags(self) -> bool:
        return True

    def ballot(self, agents: int) -> Ballot | None:
        if self.agents is not None:
            return None
        everyone = tuple(map(float, range(agents)))
        return Ballot("who may fire", everyone, True, self.period_episodes, self.override_prob)

    def check(self, game: Any) -> None:
        check_agent_indices("Sanctioner.agents", self.agents or (), game.agents)


class Arrays(NamedTuple):
    """Who may fire."""

    named: Annotated[Bool, "N"]
    """Whether the agent may fire where none is elected."""
    ballot: int
    """The ballot that elects who may fire; -1 for none."""
    may_fire: Annotated[Bool, "B N", DERIVED]
    """Whether the agent may fire now."""


def parameters(game: Any) -> dict[str, Any]:
    sanctioner, ballot = next(iter(with_ballots(game, Sanctioner)), (Sanctioner(), -1))
    named = sanctioner.agents or range(game.agents)
    return {"named": [agent in named for agent in range(game.agents)], "ballot": ballot}


def appoint(sanctioner: Arrays, ledger: Ledger) -> None:
    """Write who may fire: the elected agent, or those that the game names."""
    for i in range(sanctioner.may_fire.shape[0]):
        if sanctioner.ballot >= 0:
            sanctioner.may_fire[i] = ledger.in_force[sanctioner.ballot] == i
        else:
            sanctioner.may_fire[i] = sanctioner.named[i]


def show_may_fire(sanctioner: Arrays, i: int) -> float:
    """1 if the agent may fire."""
    return 1.0 if sanctioner.may_fire[i] else 0.0
