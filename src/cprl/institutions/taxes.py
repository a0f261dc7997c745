"""Taxes on the harvest, and levies of nested groups."""

from dataclasses import dataclass
from typing import Any, ClassVar, Final, Literal, get_args

from cprl.checks import Check, check_fields, count, is_count, is_number, one_of
from cprl.institutions.base import OBSERVED, PROBABILITY, Institution, check_agent_indices

Redistribution = Literal["equal", "none"]


@dataclass(frozen=True, kw_only=True)
class Tax(Institution):
    """A tax on the harvest, collected at the end of every period and at the end of the episode.

    The base is the apples harvested in the period, before all fines and other taxes, so several taxes are
    independent of their order. What is collected counts as a fine, what is paid out as a transfer. Agents
    observe nothing of a fixed tax.
    """

    rate: float = 0.1
    """The share of the harvest that is taken, 0..1, where there are no brackets."""

    redistribution: Redistribution = "equal"
    """"equal": what was collected is paid out in equal parts to all agents at once; "none": it is lost."""

    period_steps: int = 1
    """The length of a period in turns, at least 1."""

    brackets: tuple[tuple[float, float], ...] = ()
    """(apples, rate) pairs in ascending order, the first from 0: of the apples of a period, those from here
    up to the next bracket are taxed at this rate, 0..1. Empty for `rate` alone."""

    principle: ClassVar[str] = "2 rules that fit local conditions"

    def __post_init__(self) -> None:
        check_fields(self, _TAX)


@dataclass(frozen=True, kw_only=True)
class Levies(Institution):
    """Groups within the group, each of which shares a part of its harvest, beside a part that all share
    (Ostrom's principle 8, nested enterprises).

    Every turn `local_rate` of each harvest is divided equally within the agent's group, and `joint_rate` of
    it equally among all agents.
    """

    groups: tuple[tuple[int, ...], ...]
    """The agent indices of each group; each agent is in exactly one."""

    local_rate: float = 0.2
    """The share of the harvest that stays within the group, 0..1."""

    joint_rate: float = 0.1
    """The share of the harvest that goes to all, 0..1; both rates together are at most 1."""

    principle: ClassVar[str] = "8 nested enterprises"

    def __post_init__(self) -> None:
        check_fields(self, _LEVIES)
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


def _are_brackets(value: Any) -> bool:
    if not isinstance(value, tuple) or not all(
        isinstance(bracket, tuple) and len(bracket) == 2 for bracket in value
    ):
        return False
    starts = [bracket[0] for bracket in value]
    return (
        all(is_number(start, 0, 1e6) and is_number(rate, 0, 1) for start, rate in value)
        and starts == sorted(set(starts))
        and (not starts or starts[0] == 0)
    )


def _are_groups(value: Any) -> bool:
    return (
        isinstance(value, tuple)
        and bool(value)
        and all(isinstance(group, tuple) and group and all(is_count(i, 0) for i in group) for group in value)
    )


_TAX: Final[dict[str, Check]] = {
    **OBSERVED,
    "rate": PROBABILITY,
    "redistribution": one_of(*get_args(Redistribution)),
    "period_steps": count(1),
    "brackets": Check(_are_brackets, "(apples, rate) pairs, ascending from 0 apples, rates in 0..1"),
}
_LEVIES: Final[dict[str, Check]] = {
    **OBSERVED,
    "groups": Check(_are_groups, "a tuple of agent indices for each group"),
    "local_rate": PROBABILITY,
    "joint_rate": PROBABILITY,
}
