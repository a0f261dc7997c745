"""Spaces: the shapes of observations and actions, from which learners and networks are made."""

from dataclasses import dataclass
from typing import Annotated, Final

from cprl.values import Positive, Range, Value, Where

DTYPES: Final = (
    *("bool", "uint8", "uint16", "uint32", "uint64", "int8", "int16", "int32", "int64"),
    *("float16", "float32", "float64"),  # numpy has no bfloat16
)
Dtype = Annotated[str, Where(lambda name: name in DTYPES, ", ".join(map(repr, DTYPES)))]
"""The name of a dtype, as numpy and torch share it."""


@dataclass(frozen=True, kw_only=True)
class Spaces(Value, stored=False):
    """The observation and action space of N agents, which is the same for each of them.

    `Game.spaces` returns the spaces of a game, and `cprl.envs.spaces_of(env)` those of an environment with
    its transforms.
    """

    agents: Positive
    """The number of agents N."""
    observation_shape: tuple[Positive, ...]
    """The shape of ("agents", "observation") for one agent; (C, X, Y) for windows."""
    observation_dtype: Dtype = "uint8"
    """The dtype of observations."""
    observation_scale: Annotated[float, Range(1e-30, 2.0**64)] = 255.0
    """The number by which networks divide observations: the largest value of integer observations, 1 for
    floating-point ones."""
    actions: Positive
    """The number of actions A from which an agent chooses."""
    talk: bool = False
    """Whether agents whose plans language models make send each other messages, in a game that is no
    `cprl.Game`: the attribute `talk` of its environment."""
