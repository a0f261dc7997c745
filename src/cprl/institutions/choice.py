"""What agents decide themselves: votes on a tax or a quota, and elections."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import prod
from typing import Annotated, ClassVar, Final, NamedTuple

from cprl.institutions.base import MOST_APPLES, Amount, Institution, check_agent_indices, check_no_election
from cprl.institutions.monitoring import ELECTED, Monitoring
from cprl.institutions.quotas import Quota
from cprl.institutions.taxes import Tax
from cprl.values import AgentIndices, Positive, Share, Where

MOST_DECISIONS: Final = 2**20
"""The largest number of options that an agent chooses from."""

Choices = Annotated[
    tuple[Amount, ...],
    Where(
        lambda choices: len(choices) >= 2 and list(choices) == sorted(set(choices)),
        f"two or more numbers in 0..{MOST_APPLES:g}, ascending",
    ),
]


@dataclass(frozen=True, kw_only=True)
class Vote(Institution):
    """Agents vote on the rate of a tax or the share of a quota (Ostrom's principle 3, collective choice).

    Each agent's decision is the index of a choice; the median of the N decisions counts, of two middle ones
    the lower. Agents observe the value in force.
    """

    on: Tax | Quota
    """The institution whose `rate` or `share` is voted on; its own value is not used."""

    choices: Choices = (0.0, 0.25, 0.5, 0.75, 1.0)
    """The values to choose from, ascending, at least two; of a tax 0..1."""

    period_episodes: Positive = 1
    """A vote is held in every such number of episodes, from the first one; its result stays in force until
    the next."""

    override_prob: Share = 0.0
    """The probability that an authority from outside puts a choice in force by chance, all equally likely, in
    place of the result of a vote (the opposite of Ostrom's principle 7, the right to organise)."""

    principle: ClassVar[str] = "3 collective choice"

    def __post_init__(self) -> None:
        super().__post_init__()
        if isinstance(self.on, Tax) and (self.on.brackets or self.choices[-1] > 1):
            raise ValueError(
                "Vote.on is a Tax with brackets; allowed: a Tax with one rate"
                if self.on.brackets
                else f"Vote.choices has {self.choices[-1]:g}; allowed for a Tax: 0..1"
            )


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

    principle: ClassVar[str] = "7 the right to organise"
    at_most: ClassVar[int | None] = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.agents is not None:
            check_no_election(self, "agents is None, so that they are elected")

    def check_board(self, *, agents: int, height: int, width: int) -> None:
        check_agent_indices("Sanctioner.agents", self.agents or (), agents)


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


def is_decided(institution: Institution) -> bool:
    """Whether agents decide something about this institution, so that it has a ballot."""
    return bool(ballots((institution,), agents=1))


def ballots(institutions: Sequence[Institution], agents: int) -> tuple[Ballot, ...]:
    """What N agents decide on, in the order of the institutions.

    A decision is one number for all ballots: the choice of the first one plus its number of choices times the
    choice of the second one, and so on.
    """
    held = []
    everyone = tuple(float(agent) for agent in range(agents))
    for institution in institutions:
        if isinstance(institution, Vote):
            title = "the tax rate" if isinstance(institution.on, Tax) else "the quota's share"
            held.append(
                Ballot(
                    title, institution.choices, False, institution.period_episodes, institution.override_prob
                )
            )
        elif isinstance(institution, Sanctioner) and institution.agents is None:
            held.append(
                Ballot("who may fire", everyone, True, institution.period_episodes, institution.override_prob)
            )
        elif isinstance(institution, Monitoring) and institution.monitor == ELECTED:
            held.append(Ballot("who monitors", everyone, True, institution.period_episodes, 0.0))
    return tuple(held)


def decision_options(institutions: Sequence[Institution], agents: int) -> int:
    """The number of options of ("agents", "decision"); 0 where there is nothing to decide."""
    sizes = [len(ballot.choices) for ballot in ballots(institutions, agents)]
    return prod(sizes) if sizes else 0
