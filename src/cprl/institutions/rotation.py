"""Rotation: agents take turns in harvesting."""

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, NamedTuple

from cprl.institutions.base import Amount, Limit, columns
from cprl.institutions.ledger import Ledger
from cprl.values import Positive
from cprl.values.arrays import Bool, Float64, Int32


@dataclass(frozen=True, kw_only=True)
class Rotation(Limit):
    """A right of access that goes round: in each window of turns one agent may harvest (Ostrom's principle
    2, rules that fit local conditions).

    Windows follow one another from the first turn of an episode: the first one belongs to agent 0, the next
    to agent 1, and so on, and after the last agent's to agent 0 again. Agents observe whether they may
    harvest in the coming turn, and the part of the window that is left.
    """

    window_steps: Positive = 25
    """The length of a window in turns."""

    fine: Amount | None = None
    """None: nobody else can harvest. A number: it can be done, is a violation, and each bite costs so many
    apples if it is detected."""

    counts: ClassVar[tuple[str, ...]] = ("closed_bites",)
    entries: ClassVar[tuple[str, ...]] = ("may harvest", "window time")


class Arrays(NamedTuple):
    """All rotations of a game, one per index of axis R."""

    window_steps: Annotated[Int32, "R"]
    is_stopped: Annotated[Bool, "R"]
    fine: Annotated[Float64, "R"]


def parameters(game: Any) -> dict[str, Any]:
    return columns(Rotation, Arrays, game)


def is_out_of_turn(rotations: Arrays, ledger: Ledger, r: int, i: int, turn: int) -> bool:
    """Return whether a turn is not agent i's to harvest."""
    return (turn - 1) // rotations.window_steps[r] % ledger.fines.shape[0] != i


def show_rotation(rotations: Arrays, ledger: Ledger, what: int, r: int, i: int, turn: int) -> float:
    """1 if agent i may harvest in the coming turn; the part of the window that is left."""
    if what == 0:
        return 0.0 if is_out_of_turn(rotations, ledger, r, i, turn + 1) else 1.0
    return (rotations.window_steps[r] - turn % rotations.window_steps[r]) / rotations.window_steps[r]
