"""Sanctioner: only some agents may fire, listed or elected ones."""

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, NamedTuple

from cprl.institutions.arrays import DERIVED
from cprl.institutions.institution import (
    Ballot,
    Institution,
    check_agent_indices,
    check_no_election,
    with_ballots,
)
from cprl.institutions.ledger import Ledger
from cprl.values import AgentIndices, Positive, Share
from cprl.values.array_types import Bool


@dataclass(frozen=True, kw_only=True)
class Sanctioner(Institution):
    """Only some agents may fire: the listed ones, or one that all agents elect.

    This is Ostrom's principle 7, the right to organise. In an election each agent decides for the index of an
    agent. The agent with most votes wins, and chance decides between agents with equally many. Agents observe
    whether they may fire.
    """

    agents: AgentIndices | None = None
    """The agents that may fire; None for an election."""

    period_episodes: Positive = 1
    """The number of episodes from one election to the next; the first one is in the first episode."""

    override_prob: Share = 0.0
    """The probability that an outside authority overrides an election and appoints an agent by chance, all
    equally likely."""

    entries: ClassVar[tuple[str, ...]] = ("may fire",)
    most_in_game: ClassVar[int | None] = 1

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
        return Ballot(
            title="who may fire",
            choices=everyone,
            is_election=True,
            period_episodes=self.period_episodes,
            override_prob=self.override_prob,
        )

    def check(self, game: Any) -> None:
        check_agent_indices("Sanctioner.agents", self.agents or (), game.agents)


class SanctionerArrays(NamedTuple):
    """The agents that may fire."""

    is_listed: Annotated[Bool, "N"]
    """True for agents that may fire if there is no election."""
    ballot: int
    """The ballot that elects the agent that may fire; -1 for none."""
    may_fire: Annotated[Bool, "B N", DERIVED]
    """True for agents that may fire now."""


def parameters(game: Any) -> dict[str, Any]:
    """Return the parameters in `SanctionerArrays` by name; without a `Sanctioner` all agents may fire."""
    sanctioner, ballot = next(iter(with_ballots(game, Sanctioner)), (Sanctioner(), -1))
    listed = sanctioner.agents or range(game.agents)
    return {"is_listed": [agent in listed for agent in range(game.agents)], "ballot": ballot}


def appoint(sanctioner: SanctionerArrays, ledger: Ledger) -> None:
    """Write which agents may fire: the elected one, or those that the game lists."""
    for agent in range(sanctioner.may_fire.shape[0]):
        if sanctioner.ballot >= 0:
            sanctioner.may_fire[agent] = ledger.in_force[sanctioner.ballot] == agent
        else:
            sanctioner.may_fire[agent] = sanctioner.is_listed[agent]


def show_may_fire(sanctioner: SanctionerArrays, agent: int) -> float:
    """Return what an agent observes of the sanctioner: 1 if it may fire, else 0."""
    return 1.0 if sanctioner.may_fire[agent] else 0.0
