"""Rotation: agents take turns in harvesting."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, NamedTuple

from cprl.institutions.institution import Amount, Limit
from cprl.institutions.ledger import Ledger
from cprl.values import Positive
from cprl.values.array_types import Bool, Float64, Int32


@dataclass(frozen=True, kw_only=True)
class Rotation(Limit):
    """Agents take turns in harvesting: in each window of time only one agent may harvest.

    This is Ostrom's principle 2, rules that fit local conditions. Windows follow one another from the first
    turn of an episode. The first window belongs to agent 0, the next one to agent 1, and so on; after the
    last agent it is agent 0 again. Agents observe whether they may harvest in the coming turn, and the part
    of the window that is left.
    """

    window_steps: Positive = 25
    """The length of a window in turns."""

    fine: Amount | None = None
    """The fine in apples for each harvest out of turn, which is a violation, if it is detected. None makes
    such harvests impossible."""

    counts: ClassVar[tuple[str, ...]] = ("closed_bites",)
    entries: ClassVar[tuple[str, ...]] = ("may harvest", "window time")


class RotationArrays(NamedTuple):
    """The parameters of all `Rotation` of a game, one of them per index of axis R."""

    window_steps: Annotated[Int32, "R"]
    is_stopped: Annotated[Bool, "R"]
    fine: Annotated[Float64, "R"]


def is_out_of_turn(rotations: RotationArrays, ledger: Ledger, rotation: int, agent: int, turn: int) -> bool:
    """Return whether an agent may not harvest in a turn, counted from 1, under a rotation."""
    return (turn - 1) // rotations.window_steps[rotation] % ledger.fines.shape[0] != agent


def show_rotation(
    rotations: RotationArrays, ledger: Ledger, entry: int, rotation: int, agent: int, turn: int
) -> float:
    """Return what an agent observes of a rotation after a turn, 0..1.

    Entry 0 is 1 if it may harvest in the coming turn; entry 1 is the part of the window that is left.
    """
    if entry == 0:
        return 0.0 if is_out_of_turn(rotations, ledger, rotation, agent, turn + 1) else 1.0
    return (
        rotations.window_steps[rotation] - turn % rotations.window_steps[rotation]
    ) / rotations.window_steps[rotation]
