"""Spaces: what every agent of an environment observes and may do; learners and networks are made from it."""

from dataclasses import dataclass
from typing import Annotated, Final

from cprl.values import Positive, Range, Value, Where

DTYPES: Final = (
    *("bool", "uint8", "uint16", "uint32", "uint64", "int8", "int16", "int32", "int64"),
    *("float16", "float32", "float64"),  # numpy has no bfloat16
)
Dtype = Annotated[str, Where(lambda name: name in DTYPES, ", ".join(map(repr, DTYPES)))]
"""By the name that numpy and torch share."""


@dataclass(frozen=True, kw_only=True)
class Spaces(Value, stored=False):
    """The observation and action spaces of N agents, the same for each.

    `Game.spaces` gives those of a game, `cprl.envs.spaces_of(env)` those of an environment with its
    transforms.
    """

    agents: Positive
    """The number of agents N."""
    observation_shape: tuple[Positive, ...]
    """Of ("agents", "observation") of one agent; (C, X, Y) for windows."""
    observation_dtype: Dtype = "uint8"
    """Its dtype, by numpy's and torch's common name."""
    observation_scale: Annotated[float, Range(1e-30, 2.0**64)] = 255.0
    """By which networks divide observations: the largest value of integers, 1 for floating-point numbers."""
    actions: Positive
    """How many actions A an agent chooses from."""
