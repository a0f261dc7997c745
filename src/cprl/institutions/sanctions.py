"""GraduatedSanctions: time-outs and fines that grow with an agent's offences."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np

from cprl.institutions.arrays import IN_STATE, STEPS
from cprl.institutions.institution import A_RULE_TO_BREAK, Amount, Institution, with_ballots
from cprl.institutions.ledger import SANCTIONS, Ledger
from cprl.values import Natural, Positive, Where
from cprl.values.array_types import Bool, Float64, Int32

Offence = Literal["tags", "violations", "both"]
"""The kinds of offences, see `GraduatedSanctions.on`."""
Freezes = Annotated[
    tuple[Natural, ...] | tuple[tuple[Natural, ...], ...],
    Where(
        lambda steps: (
            len(steps) > 0
            and (isinstance(steps[0], int) or (len({len(row) for row in steps}) == 1 and len(steps[0]) > 0))
        ),
        "integers >= 0 by level, or equally long rows of them by shooter",
    ),
]
Fines = Annotated[tuple[Amount, ...], Where(len, "one or more numbers >= 0, by level")]


@dataclass(frozen=True, kw_only=True)
class GraduatedSanctions(Institution):
    """Time-outs and fines that grow with an agent's offences, and shrink again after a time without one.

    This is Ostrom's principle 5, graduated sanctions. Being tagged by another agent is an offence, or a
    detected violation, or both, see `on`. An agent's first offence is punished at level 0, and every offence
    raises the level for the next one. Agents observe their level, 0..1. With a governor of
    "sanctions.level" first offences are punished at the level that it sets.
    """

    freeze_steps: Freezes = (5, 25, 100, 100)
    """The turns that an offender misses, by level; the last entry also applies to every higher level. For
    tags this replaces `Rules.freeze_steps`. With on="tags" it can also be a table, with a row for each agent
    that tags."""

    fines: Fines = (0.0, 1.0, 2.0, 4.0)
    """The apples that an offender pays, by level; the last entry also applies to every higher level."""

    recovery_steps: Positive | None = 50
    """The number of turns without an offence after which the level falls by one; None if it never falls."""

    on: Offence = "both"
    """The offences. "tags": an agent is tagged by another one. "violations": it breaks a rule of another
    institution, and that is detected. "both": either of them."""

    entries: ClassVar[tuple[str, ...]] = ("sanction level",)
    most_in_game: ClassVar[int | None] = 1
    counts: ClassVar[tuple[str, ...]] = ("sanctions", "returns_to_violation")
    voted_on: ClassVar[str] = "the level of a first offence"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.is_table and self.on != "tags":
            raise ValueError(
                f'GraduatedSanctions.on is "{self.on}" and freeze_steps has a row per agent; allowed with '
                'such a table: on="tags"'
            )

    @property
    def is_table(self) -> bool:
        """Return whether `freeze_steps` has a row for each agent that tags."""
        return isinstance(self.freeze_steps[0], tuple)

    @property
    def is_for_tags(self) -> bool:
        """Return whether a tag is an offence."""
        return self.on != "violations"

    @property
    def needs_tags(self) -> bool:
        return self.on == "tags"

    def check_choices(self, name: str, choices: Sequence[float]) -> None:
        highest = max(np.shape(self.freeze_steps)[-1], len(self.fines)) - 1
        if choices[-1] > highest or any(choice % 1 for choice in choices):
            raise ValueError(
                f"{name} is {tuple(choices)}; allowed for these GraduatedSanctions: levels, whole numbers in "
                f"0..{highest}"
            )

    def check(self, game: Any) -> None:
        if self.is_table and len(self.freeze_steps) != game.agents:
            raise ValueError(
                f"GraduatedSanctions.freeze_steps has {len(self.freeze_steps)} rows; allowed: {game.agents}, "
                "one per agent"
            )
        is_idle = self.on == "violations" or (self.on == "both" and not game.rules.may_fire)
        if is_idle and not any(other.can_be_broken for other in game.institutions):
            raise ValueError(
                f'GraduatedSanctions with on="{self.on}" has no offence to sanction; allowed: '
                f"{A_RULE_TO_BREAK}"
            )


class SanctionArrays(NamedTuple):
    """The sanctions of a game by level, on axis L, and the level of each agent."""

    freeze_steps: Annotated[Int32, "N L"]
    """The time-out by shooter and level."""
    fine: Annotated[Float64, "fines"]
    """The fine by level."""
    recovery_steps: int
    """The turns without an offence after which a level falls; 0 for never."""
    for_tags: bool
    for_violations: bool
    ballot: int
    """The index in force of the level of a first offence; -1 for none, and level 0."""
    level: Annotated[Int32, "B N", IN_STATE]
    """The level of the next sanction, above that of a first offence."""
    offence_step: Annotated[Int32, "B N", STEPS]
    """The step of the agent's last offence, or of the last fall of its level if that was later."""


def parameters(game: Any) -> dict[str, Any]:
    """Return the parameters in `SanctionArrays`; without `GraduatedSanctions` nothing is an offence."""
    in_game = with_ballots(game, GraduatedSanctions)
    sanctions, ballot = in_game[0] if in_game else (GraduatedSanctions(recovery_steps=None), -1)
    levels = np.atleast_2d(sanctions.freeze_steps)
    return {
        "freeze_steps": np.broadcast_to(levels, (game.agents, levels.shape[1])),
        "fine": sanctions.fines,
        "recovery_steps": sanctions.recovery_steps or 0,
        "for_tags": bool(in_game) and sanctions.is_for_tags,
        "for_violations": bool(in_game) and sanctions.on != "tags",
        "ballot": ballot,
    }


def forget_offences(sanctions: SanctionArrays) -> None:
    """Clear the levels of all agents when an episode begins."""
    for agent in range(sanctions.level.shape[0]):
        sanctions.level[agent] = 0
        sanctions.offence_step[agent] = 0


def next_level(sanctions: SanctionArrays, ledger: Ledger, agent: int) -> int:
    """Return the level at which the next offence of an agent is punished."""
    if sanctions.ballot < 0:
        return sanctions.level[agent]
    return sanctions.level[agent] + int(ledger.in_force[sanctions.ballot])


def time_out(sanctions: SanctionArrays, ledger: Ledger, shooter: int, agent: int) -> int:
    """Return the turns that an agent misses for an offence at its level; `shooter`: who tagged it."""
    level = next_level(sanctions, ledger, agent)
    return sanctions.freeze_steps[shooter, min(level, sanctions.freeze_steps.shape[1] - 1)]


def offend(sanctions: SanctionArrays, ledger: Ledger, agent: int, turn: int) -> None:
    """Let an agent pay the fine of its level for an offence, and raise its level by one."""
    level = next_level(sanctions, ledger, agent)
    ledger.fines[agent] += sanctions.fine[min(level, sanctions.fine.shape[0] - 1)]
    sanctions.level[agent] += 1
    sanctions.offence_step[agent] = turn
    ledger.counts[agent, SANCTIONS] += 1


def sanction_tag(
    sanctions: SanctionArrays, ledger: Ledger, tagged_by: Bool, agent: int, turn: int, freeze_steps: int
) -> int:
    """Punish an agent for being tagged, if that is an offence, and return the turns that it misses.

    `tagged_by`: bool [N, N]; `freeze_steps`: the turns that it misses if being tagged is no offence.
    """
    if not sanctions.for_tags:
        return freeze_steps
    steps = 0
    for shooter in range(tagged_by.shape[0]):
        if tagged_by[agent, shooter]:
            steps = max(steps, time_out(sanctions, ledger, shooter, agent))
    offend(sanctions, ledger, agent, turn)
    return steps


def sanction_violation(sanctions: SanctionArrays, ledger: Ledger, agent: int, turn: int) -> int:
    """Punish an agent for a detected violation, if that is an offence; return the turns that it misses."""
    if not sanctions.for_violations:
        return 0
    steps = time_out(sanctions, ledger, agent, agent)
    offend(sanctions, ledger, agent, turn)
    return steps


def forgive(sanctions: SanctionArrays, turn: int) -> None:
    """Lower the level of agents whose last offence, or last fall of level, is `recovery_steps` turns ago."""
    if sanctions.recovery_steps > 0:
        for agent in range(sanctions.level.shape[0]):
            if (
                sanctions.level[agent] > 0
                and turn - sanctions.offence_step[agent] >= sanctions.recovery_steps
            ):
                sanctions.level[agent] -= 1
                sanctions.offence_step[agent] = turn


def show_level(sanctions: SanctionArrays, ledger: Ledger, agent: int) -> float:
    """Return what an agent observes of its level: the level relative to the highest one, 0..1."""
    last = max(1, sanctions.fine.shape[0] - 1, sanctions.freeze_steps.shape[1] - 1)
    return min(next_level(sanctions, ledger, agent), last) / last
