"""Spaces: what every agent of an environment observes and may do; learners and networks are made from it."""

from dataclasses import dataclass
from typing import Any, Final

from cprl.checks import Check, check_fields, count, is_count, number, one_of, tuple_of

DTYPES: Final = (
    *("bool", "uint8", "uint16", "uint32", "uint64", "int8", "int16", "int32", "int64"),
    *("float16", "float32", "float64"),  # numpy has no bfloat16
)


@dataclass(frozen=True, kw_only=True)
class Spaces:
    """The observation and action spaces of N agents, the same for each.

    `Game.spaces` gives those of a game, `cprl.envs.spaces_of(env)` those of an environment with its
    transforms.

    Raises:
        ValueError: if a value is not allowed; names it and says what is.
    """

    agents: int
    """The number of agents N."""
    observation_shape: tuple[int, ...]
    """Of ("agents", "observation") of one agent; (C, X, Y) for windows."""
    observation_dtype: str = "uint8"
    """Its dtype, by numpy's and torch's common name."""
    observation_scale: float = 255.0
    """By which networks divide observations: the largest value of integers, 1 for floating-point numbers."""
    actions: int
    """How many actions A an agent chooses from; 0 where actions are continuous."""
    action_size: int = 0
    """How many numbers D a continuous action has; 0 where agents choose from `actions`."""
    action_low: float = -1.0
    """The least value of each number of a continuous action."""
    action_high: float = 1.0
    """The largest."""
    vectors: tuple[tuple[str, int], ...] = ()
    """Further entries under "agents" that agents observe, each with its length, e.g. ("scoreboard", N)."""

    def __post_init__(self) -> None:
        check_fields(self, _CHECKS)
        if not self.actions and not self.action_size:
            raise ValueError("Spaces.actions is 0; allowed: 1 or more, or an action_size of 1 or more")
        if self.actions and self.action_size:
            raise ValueError(
                f"Spaces.action_size is {self.action_size}; allowed with actions {self.actions}: 0"
            )
        if self.action_size and not self.action_low < self.action_high:
            raise ValueError(
                f"Spaces.action_low is {self.action_low}; allowed: below action_high, {self.action_high}"
            )

    @property
    def action_shape(self) -> tuple[int, ...]:
        """The shape of an agent's action: (D,) if it is continuous, else ()."""
        return (self.action_size,) if self.action_size else ()

    @property
    def action_dtype(self) -> str:
        """The dtype of actions, by numpy's and torch's common name."""
        return "float32" if self.action_size else "int64"

    @property
    def actions_text(self) -> str:
        """What an agent may do, in words."""
        if not self.action_size:
            return f"{self.actions} actions to choose from"
        return f"actions of {self.action_size} numbers in {self.action_low:g}..{self.action_high:g}"


def _is_vector(value: Any) -> bool:
    return (
        isinstance(value, tuple)
        and len(value) == 2
        and isinstance(value[0], str)
        and value[0] != ""
        and is_count(value[1], 1)
    )


_CHECKS: Final[dict[str, Check]] = {
    "agents": count(1),
    "observation_shape": tuple_of(count(1)),
    "observation_dtype": one_of(*DTYPES),
    "observation_scale": number(1e-30, 2**64),
    "actions": count(0),
    "action_size": count(0, 2**16),
    **dict.fromkeys(("action_low", "action_high"), number(-1e9, 1e9)),
    "vectors": tuple_of(Check(_is_vector, "the name of an entry and its length")),
}
