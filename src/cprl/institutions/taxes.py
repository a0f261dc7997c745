"""Taxes on the harvest, and levies of nested groups."""

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np

from cprl.institutions.arrays import STATE
from cprl.institutions.base import Amount, Institution, check_agent_indices, with_ballots
from cprl.institutions.ledger import Ledger
from cprl.values import Natural, Positive, Share, Where
from cprl.values.arrays import Float64, Int32

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

    voted_on: ClassVar[str] = "the tax rate"


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

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.local_rate + self.joint_rate > 1:
            raise ValueError(
                f"Levies.joint_rate is {self.joint_rate:g} and local_rate is {self.local_rate:g}; allowed: "
                "at most 1 together"
            )

    def check(self, game: Any) -> None:
        members = sorted(agent for group in self.groups for agent in group)
        check_agent_indices("Levies.groups", members, game.agents)
        if members != list(range(game.agents)):
            raise ValueError(
                f"Levies.groups has the agents {members}; allowed: each of 0 to {game.agents - 1} exactly "
                "once"
            )

    @property
    def group_of(self) -> tuple[int, ...]:
        """The index of each agent's group: [N]."""
        by_agent = {agent: number for number, group in enumerate(self.groups) for agent in group}
        return tuple(by_agent[agent] for agent in sorted(by_agent))


class Arrays(NamedTuple):
    """All taxes and levies of a game, one per index of axis T; levies are two taxes."""

    from_: Annotated[Float64, "T bounds"]
    """Where each bracket begins, and then where the last one ends; infinite for those that a tax lacks."""
    rate: Annotated[Float64, "T brackets"]
    ballot: Annotated[Int32, "T"]
    """The ballot that decides the rate; -1 for none."""
    steps: Annotated[Int32, "T"]
    """Turns per period."""
    group: Annotated[Int32, "T N"]
    """The group within which it is paid out; -1 where it is lost."""
    income: Annotated[Float64, "B T N", STATE]
    """Apples harvested in the current period."""
    owed: Annotated[Float64, "B N"]
    """The tax that each agent owes."""


def parameters(game: Any) -> dict[str, Any]:
    rows: list[tuple[int, int, tuple[int, ...], tuple[tuple[float, float], ...]]] = []
    for tax, ballot in with_ballots(game, Tax):
        group = (0 if tax.redistribution == "equal" else -1,) * game.agents
        rows.append((ballot, tax.period_steps, group, tax.brackets or ((0.0, tax.rate),)))
    for levies, _ in with_ballots(game, Levies):
        rows.append((-1, 1, levies.group_of, ((0.0, levies.local_rate),)))
        rows.append((-1, 1, (0,) * game.agents, ((0.0, levies.joint_rate),)))
    most = max((len(brackets) for *_, brackets in rows), default=1)
    from_, rate = np.full((len(rows), most + 1), np.inf), np.zeros((len(rows), most))
    for tax_number, (*_, brackets) in enumerate(rows):
        from_[tax_number, : len(brackets)], rate[tax_number, : len(brackets)] = np.transpose(brackets)
    ballots, steps, groups, _ = zip(*rows, strict=True) if rows else ((), (), (), ())
    group_of = np.reshape(groups, (-1, game.agents))
    return {"from_": from_, "rate": rate, "ballot": ballots, "steps": steps, "group": group_of}


def forget_income(taxes: Arrays) -> None:
    """Forget the harvests of the last episode."""
    for tax in range(taxes.income.shape[0]):
        for i in range(taxes.income.shape[1]):
            taxes.income[tax, i] = 0.0


def note_income(taxes: Arrays, i: int) -> None:
    """Note a harvest of agent i."""
    for tax in range(taxes.steps.shape[0]):
        taxes.income[tax, i] += 1.0


def collect_taxes(taxes: Arrays, ledger: Ledger, turn: int, is_over: bool) -> None:
    """Collect and pay out the taxes whose period ends with this turn, or with the episode."""
    agents = ledger.fines.shape[0]
    for tax in range(taxes.steps.shape[0]):
        if (is_over or turn % taxes.steps[tax] == 0) and has_income(taxes, tax):
            for i in range(agents):
                taxes.owed[i] = tax_of(taxes, ledger, tax, i)
                ledger.fines[i] += taxes.owed[i]
                taxes.income[tax, i] = 0.0
            for i in range(agents):
                if taxes.group[tax, i] >= 0:
                    pay_out(taxes, ledger, tax, i)


def has_income(taxes: Arrays, tax: int) -> bool:
    """Return whether any agent harvested in the period of a tax."""
    for i in range(taxes.income.shape[1]):
        if taxes.income[tax, i] > 0:
            return True
    return False


def tax_of(taxes: Arrays, ledger: Ledger, tax: int, i: int) -> float:
    """Return the apples that agent i owes on its harvest of the period."""
    income, owed = taxes.income[tax, i], 0.0
    if taxes.ballot[tax] >= 0:
        return ledger.in_force[taxes.ballot[tax]] * income
    for bracket in range(taxes.rate.shape[1]):
        from_ = taxes.from_[tax, bracket]
        if income > from_:
            upper = min(income, taxes.from_[tax, bracket + 1])
            owed += taxes.rate[tax, bracket] * (upper - from_)
    return owed


def pay_out(taxes: Arrays, ledger: Ledger, tax: int, i: int) -> None:
    """Give agent i its equal part of what its group owed."""
    pool, members = 0.0, 0
    for j in range(ledger.fines.shape[0]):
        if taxes.group[tax, j] == taxes.group[tax, i]:
            pool += taxes.owed[j]
            members += 1
    ledger.transfers[i] += pool / members
