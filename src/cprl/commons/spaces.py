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
    """How many actions A an agent chooses from."""
    vectors: tuple[tuple[str, int], ...] = ()
    """Further entries under "agents" that agents observe, each with its length, e.g. ("scoreboard", N)."""

    def __post_init__(self) -> None:
        check_fields(self, _CHECKS)


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
    "actions": count(1),
    "vectors": tuple_of(Check(_is_vector, "the name of an entry and its length")),
}
