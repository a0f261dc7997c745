"""What follows an offence: graduated sanctions, and mediation of tags."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from cprl.institutions.base import Amount, Institution
from cprl.values import Natural, Positive, Where

Offence = Literal["tags", "violations", "both"]
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
    """Time-outs and fines that grow with an agent's offences and fall back after a while without one
    (Ostrom's principle 5).

    An offence is to be tagged by another agent, a detected violation, or either. The first offence is at
    level 0; each one raises the level of the next. Agents observe their level, 0..1.
    """

    freeze_steps: Freezes = (5, 25, 100, 100)
    """The turns that an offender misses, by level; the last entry also applies to every higher level. A table
    has a row for each agent that tags, and is allowed with on="tags" alone. For tags it takes the place of
    `Rules.freeze_steps`."""

    fines: Fines = (0.0, 1.0, 2.0, 4.0)
    """The apples that an offender pays, by level; the last entry also applies to every higher level."""

    recovery_steps: Positive | None = 50
    """After each such number of turns without an offence the level falls by one; None for never."""

    on: Offence = "both"
    """What is an offence: "tags", to be tagged by another agent; "violations" of rules of other institutions,
    if they are detected; "both"."""

    principle: ClassVar[str] = "5 graduated sanctions"
    at_most: ClassVar[int | None] = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.is_table and self.on != "tags":
            raise ValueError(
                f'GraduatedSanctions.on is "{self.on}" and freeze_steps has a row per agent; allowed with '
                'such a table: on="tags"'
            )

    @property
    def is_table(self) -> bool:
        """Whether `freeze_steps` has a row for each agent that tags."""
        return isinstance(self.freeze_steps[0], tuple)

    def check_board(self, *, agents: int, height: int, width: int) -> None:
        if self.is_table and len(self.freeze_steps) != agents:
            raise ValueError(
                f"GraduatedSanctions.freeze_steps has {len(self.freeze_steps)} rows; allowed: {agents}, one "
                "per agent"
            )


@dataclass(frozen=True, kw_only=True)
class Mediation(Institution):
    """A tag of an agent that broke no rule is unjust, and refunded by the shooter (Ostrom's principle 6,
    conflict resolution).

    A tag is unjust if the tagged agent has violated no rule in this turn and the `turns` - 1 before it. It is
    a violation by each agent that tagged; together they pay `refund` to the tagged one, detected or not.
    Agents observe which agents have violated a rule in the last `turns`, their own mark first, then those of
    the following indices, cyclically; to know them apart they need `Observation.agents_apart`.
    """

    turns: Positive = 10
    """The number of turns, this one included, in which a violation justifies a tag."""

    refund: Amount = 1.0
    """The apples that the tagged agent is paid."""

    principle: ClassVar[str] = "6 conflict resolution"
    at_most: ClassVar[int | None] = 1
    needs: ClassVar[tuple[str, ...]] = ("agents_apart",)
