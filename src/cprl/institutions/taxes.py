"""Tax on the harvest, and Levies, by which nested groups share a part of it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np

from cprl.institutions.arrays import IN_STATE
from cprl.institutions.institution import Amount, Institution, check_agent_indices, with_ballots
from cprl.institutions.ledger import Ledger
from cprl.values import Natural, Positive, Share, Where
from cprl.values.array_types import Float64, Int32

Redistribution = Literal["equal", "none"]
Brackets = Annotated[
    tuple[tuple[Amount, Share], ...],
    Where(
        lambda brackets: not brackets or [apples for apples, _ in brackets] == sorted({0.0, *dict(brackets)}),
        "(apples, rate) pairs, ascending from 0 apples, rates in 0..1",
    ),
]
_Groups = Annotated[
    tuple[tuple[Natural, ...], ...],
    Where(lambda groups: groups and all(groups), "a tuple of agent indices for each group"),
]


@dataclass(frozen=True, kw_only=True)
class Tax(Institution):
    """A tax on the harvest, collected at the end of every period and at the end of the episode.

    The tax is a share of the apples that an agent harvested in the period, before all fines and other taxes;
    so the order of several taxes does not matter. Collected apples count as fines, and apples that are paid
    out as transfers. Agents observe nothing of a tax, unless they vote on it.
    """

    rate: Share = 0.1
    """The share of the harvest that is taken; unused with `brackets`."""

    redistribution: Redistribution = "equal"
    """"equal": all agents receive the collected apples at once, in equal parts. "none": they are lost."""

    period_steps: Positive = 1
    """The length of a period in turns."""

    brackets: Brackets = ()
    """(apples, rate) pairs in ascending order, the first from 0 apples: the part of a period's harvest
    between the apples of a bracket and those of the next one is taxed at this rate. Empty for one `rate`."""

    voted_on: ClassVar[str] = "the tax rate"

    def check_choices(self, name: str, choices: Sequence[float]) -> None:
        if self.brackets or choices[-1] > 1:
            raise ValueError(
                f"{name} has {choices[-1]:g} for {self}; allowed: 0..1, for a Tax without brackets"
            )


@dataclass(frozen=True, kw_only=True)
class Levies(Institution):
    """Agents share one part of their harvest within their group, and another part with all agents.

    This is Ostrom's principle 8, nested enterprises. In every turn the share `local_rate` of each harvest is
    divided equally within the agent's group, and the share `joint_rate` equally among all agents.
    """

    groups: _Groups
    """The agent indices of each group; each agent is in exactly one."""

    local_rate: Share = 0.2
    """The share of the harvest that is divided within the group."""

    joint_rate: Share = 0.1
    """The share of the harvest that is divided among all agents; both rates together are at most 1."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.local_rate + self.joint_rate > 1:
            raise ValueError(
                f"Levies.joint_rate is {self.joint_rate:g} and local_rate is {self.local_rate:g}; allowed: "
                "at most 1 together"
            )

    def check(self, game: Any) -> None:
        agents = sorted(agent for group in self.groups for agent in group)
        check_agent_indices("Levies.groups", agents, game.agents)
        if agents != list(range(game.agents)):
            raise ValueError(
                f"Levies.groups has the agents {agents}; allowed: each of 0 to {game.agents - 1} exactly once"
            )

    @property
    def group_of(self) -> tuple[int, ...]:
        """Return the index of each agent's group, one entry per agent."""
        group_by_agent = {agent: index for index, group in enumerate(self.groups) for agent in group}
        return tuple(group_by_agent[agent] for agent in sorted(group_by_agent))


class TaxArrays(NamedTuple):
    """The parameters and memory of all taxes of a game, one per index of axis T.

    A `Levies` counts as two taxes: one is paid out within groups, the other among all agents.
    """

    bracket_begin: Annotated[Float64, "T bounds"]
    """The apples at which each bracket begins, with the end of the last bracket as a last entry; infinite for
    brackets that a tax lacks."""
    rate: Annotated[Float64, "T brackets"]
    ballot: Annotated[Int32, "T"]
    """The ballot that decides the rate; -1 for none."""
    period_steps: Annotated[Int32, "T"]
    """The number of turns in a period."""
    group: Annotated[Int32, "T N"]
    """The index of the group within which the tax of each agent is paid out; -1 for a tax that is lost."""
    income: Annotated[Float64, "B T N", IN_STATE]
    """The apples that each agent has harvested in the current period."""
    owed: Annotated[Float64, "B N"]
    """The tax that each agent owes."""


def parameters(game: Any) -> dict[str, Any]:
    """Return the parameters in `TaxArrays` by name."""
    # one row per tax: ballot, period, group of each agent, brackets
    rows: list[tuple[int, int, tuple[int, ...], tuple[tuple[float, float], ...]]] = []
    for tax, ballot in with_ballots(game, Tax):
        group = (0 if tax.redistribution == "equal" else -1,) * game.agents
        rows.append((ballot, tax.period_steps, group, tax.brackets or ((0.0, tax.rate),)))
    for levies, _ in with_ballots(game, Levies):
        rows.append((-1, 1, levies.group_of, ((0.0, levies.local_rate),)))
        rows.append((-1, 1, (0,) * game.agents, ((0.0, levies.joint_rate),)))
    most_brackets = max((len(brackets) for *_, brackets in rows), default=1)
    bracket_begin = np.full((len(rows), most_brackets + 1), np.inf)
    rate = np.zeros((len(rows), most_brackets))
    for row, (*_, brackets) in enumerate(rows):
        bracket_begin[row, : len(brackets)], rate[row, : len(brackets)] = np.transpose(brackets)
    ballots, steps, groups, _ = zip(*rows, strict=True) if rows else ((), (), (), ())
    group_of = np.reshape(groups, (-1, game.agents))
    return {
        "bracket_begin": bracket_begin,
        "rate": rate,
        "ballot": ballots,
        "period_steps": steps,
        "group": group_of,
    }


def forget_income(taxes: TaxArrays) -> None:
    """Clear the harvests that taxes remember when an episode begins."""
    for tax in range(taxes.income.shape[0]):
        for agent in range(taxes.income.shape[1]):
            taxes.income[tax, agent] = 0.0


def note_income(taxes: TaxArrays, agent: int) -> None:
    """Count a harvest of an agent for all taxes."""
    for tax in range(taxes.period_steps.shape[0]):
        taxes.income[tax, agent] += 1.0


def collect_taxes(taxes: TaxArrays, ledger: Ledger, turn: int, is_over: bool) -> None:
    """Collect and pay out the taxes whose period ends with this turn; `is_over`: the episode ends with it."""
    agents = ledger.fines.shape[0]
    for tax in range(taxes.period_steps.shape[0]):
        if (is_over or turn % taxes.period_steps[tax] == 0) and has_income(taxes, tax):
            for agent in range(agents):
                taxes.owed[agent] = tax_of(taxes, ledger, tax, agent)
                ledger.fines[agent] += taxes.owed[agent]
                taxes.income[tax, agent] = 0.0
            for agent in range(agents):
                if taxes.group[tax, agent] >= 0:
                    pay_out(taxes, ledger, tax, agent)


def has_income(taxes: TaxArrays, tax: int) -> bool:
    """Return whether any agent harvested in the period of a tax."""
    for agent in range(taxes.income.shape[1]):
        if taxes.income[tax, agent] > 0:
            return True
    return False


def tax_of(taxes: TaxArrays, ledger: Ledger, tax: int, agent: int) -> float:
    """Return the apples of a tax that an agent owes for its harvest in the period."""
    income = taxes.income[tax, agent]
    owed = 0.0
    if taxes.ballot[tax] >= 0:
        return ledger.in_force[taxes.ballot[tax]] * income
    for bracket in range(taxes.rate.shape[1]):
        begin = taxes.bracket_begin[tax, bracket]
        if income > begin:
            upper = min(income, taxes.bracket_begin[tax, bracket + 1])
            owed += taxes.rate[tax, bracket] * (upper - begin)
    return owed


def pay_out(taxes: TaxArrays, ledger: Ledger, tax: int, agent: int) -> None:
    """Give an agent its equal part of the tax that the members of its group owed."""
    pool = 0.0
    members = 0
    for member in range(ledger.fines.shape[0]):
        if taxes.group[tax, member] == taxes.group[tax, agent]:
            pool += taxes.owed[member]
            members += 1
    ledger.transfers[agent] += pool / members
