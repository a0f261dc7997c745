"""Spaces: what every agent of an environment observes and may do; learners and networks are made from it."""

from dataclasses import dataclass


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
