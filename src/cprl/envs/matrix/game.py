"""MatrixGame: a payoff table as a value."""

from dataclasses import KW_ONLY, asdict, dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from cprl import arguments
from cprl.checks import MOST_NUMBER, NONE, Check, check_fields, count, either, is_number, shown

if TYPE_CHECKING:
    from cprl.envs.matrix.env import MatrixEnv

_MOST_PAYOFFS: Final = 2**16


@dataclass(frozen=True)
class MatrixGame:
    """A game of N agents who choose among A actions each, at once, and are paid by a table.

    Where it is played for several turns, agents observe the last joint actions. An episode of one turn
    terminates. One of several is truncated: its end is a clock that nobody sees, so agents learn as if it
    went on; with a `continue_prob` below 1 it terminates where no further turn follows.

    Raises:
        ValueError: names the field, what came and what is allowed.
    """

    payoffs: Any
    """What all N agents are paid, float [A, ..., A, N]: an axis for the action of each agent, and their
    payoffs last; nested tuples, lists or an array."""
    _: KW_ONLY
    turns: int = 1
    """Turns of an episode, at most."""
    memory: int | None = None
    """How many of the last joint actions agents observe, each as A**N + 1 numbers; by default 1, and 0 in a
    game of one turn, in which the observation is the number 1."""
    continue_prob: float = 1.0
    """The probability that a further turn follows, above 0."""

    def __post_init__(self) -> None:
        check_fields(self, _CHECKS)
        object.__setattr__(self, "payoffs", _table(self.payoffs))
        if self.turns == 1 and self.continue_prob < 1:
            raise ValueError(
                f"MatrixGame.continue_prob is {self.continue_prob}; allowed in a game of one turn: 1.0"
            )

    @property
    def agents(self) -> int:
        """The number of agents N."""
        return np.ndim(self.payoffs) - 1

    @property
    def actions(self) -> int:
        """The number of actions A of each agent."""
        return len(self.payoffs)

    @property
    def remembered(self) -> int:
        """The number of joint actions that agents observe: `memory`, or what its default means."""
        return int(self.turns > 1) if self.memory is None else self.memory

    def to_config(self) -> dict[str, Any]:
        """Its fields."""
        return asdict(self)

    def make(self, worlds: int, seed: int, device: Any, *, first_world: int = 0) -> "MatrixEnv":
        """Its environment, so many worlds; see `MatrixEnv`."""
        from cprl.envs.matrix.env import MatrixEnv

        return MatrixEnv(self, worlds, seed=seed, device=device, first_world=first_world)


def _table(payoffs: Any) -> tuple[Any, ...]:
    """Payoffs as nested tuples of Python's floats.

    Raises:
        ValueError: for another shape, and for what is no finite number.
    """
    name = "MatrixGame.payoffs"
    table = arguments.floats(name, payoffs)
    *actions, agents = table.shape or (0,)
    if agents != len(actions) or len(set(actions)) != 1 or actions[0] < 2:
        raise ValueError(
            f"{name} has the shape {list(table.shape)}; allowed: [A, ..., A, N], N axes of A actions, at "
            "least 2, and the payoffs of the N agents"
        )
    if table.size > _MOST_PAYOFFS:
        raise ValueError(f"{name} has {table.size:,} numbers; allowed: up to {_MOST_PAYOFFS:,}")
    for number in table.flat:
        if not is_number(float(number), -MOST_NUMBER, MOST_NUMBER):
            raise ValueError(f"{name} has {shown(float(number))}; allowed: numbers up to {MOST_NUMBER:g}")
    return tuple(map(_tuples, table.tolist()))


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


_CHECKS: Final[dict[str, Check]] = {
    "turns": count(1),
    "memory": either(NONE, count(0, 64)),
    "continue_prob": Check(lambda value: is_number(value, 0, 1) and value > 0, "a number above 0, at most 1"),
}
