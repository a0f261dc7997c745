"""Taxes on the harvest, and levies of nested groups."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from cprl.institutions.base import Amount, Institution, check_agent_indices
from cprl.values import Natural, Positive, Share, Where

Redistribution = Literal["equal", "none"]
Brackets = Annotated[
    tuple[tuple[Amount, Share], ...],
    Where(
        lambda brackets: not brackets or [apples for apples, _ in brackets] == sorted({0.0, *dict(brackets)}),
        "(apples, rate) pairs, ascending from 0 apples, rates in 0..1",
    ),
]
Groups = Annotated[
    tuple[tuple[Natural, ...], ...],
    Where(lambda groups: groups and all(groups), "a tuple of agent indices for each group"),
]


@dataclass(frozen=True, kw_only=True)
class Tax(Institution):
    """A tax on the harvest, collected at the end of every period and at the end of the episode.

    The base is the apples harvested in the period, before all fines and other taxes, so several taxes are
    independent of their order. What is collected counts as a fine, what is paid out as a transfer. Agents
    observe nothing of a fixed tax.
    """

    rate: Share = 0.1
    """The share of the harvest that is taken where there are no brackets."""

    redistribution: Redistribution = "equal"
    """"equal": what was collected is paid out in equal parts to all agents at once; "none": it is lost."""

    period_steps: Positive = 1
    """The length of a period in turns."""

    brackets: Brackets = ()
    """(apples, rate) pairs in ascending order, the first from 0: of the apples of a period, those from here
    up to the next bracket are taxed at this rate. Empty for `rate` alone."""

    principle: ClassVar[str] = "2 rules that fit local conditions"


@dataclass(frozen=True, kw_only=True)
class Levies(Institution):
    """Groups within the group, each of which shares a part of its harvest, beside a part that all share
    (Ostrom's principle 8, nested enterprises).

    Every turn `local_rate` of each harvest is divided equally within the agent's group, and `joint_rate` of
    it equally among all agents.
    """

    groups: Groups
    """The agent indices of each group; each agent is in exactly one."""

    local_rate: Share = 0.2
    """The share of the harvest that stays within the group."""

    joint_rate: Share = 0.1
    """The share of the harvest that goes to all; both rates together are at most 1."""

    principle: ClassVar[str] = "8 nested enterprises"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.local_rate + self.joint_rate > 1:
            raise ValueError(
                f"Levies.joint_rate is {self.joint_rate:g} and local_rate is {self.local_rate:g}; allowed: "
                "at most 1 together"
            )

    def check_board(self, *, agents: int, height: int, width: int) -> None:
        members = sorted(agent for group in self.groups for agent in group)
        check_agent_indices("Levies.groups", members, agents)
        if members != list(range(agents)):
            raise ValueError(
                f"Levies.groups has the agents {members}; allowed: each of 0 to {agents - 1} exactly once"
            )

    @property
    def group_of(self) -> tuple[int, ...]:
        """The index of each agent's group: [N]."""
        by_agent = {agent: number for number, group in enumerate(self.groups) for agent in group}
        return tuple(by_agent[agent] for agent in sorted(by_agent))
