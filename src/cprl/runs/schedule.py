"""Schedule: how long a training lasts, and how often its agents learn."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

from cprl.runs.length import Length
from cprl.values import Steps, Value

OnNan = Literal["stop", "continue"]
"""Reactions to a number that is not finite: "stop" raises a `NotFiniteError`; "continue" warns once for each
agent and trains on."""


@dataclass(frozen=True, kw_only=True)
class Schedule(Value, stored=False, called="schedule"):
    """The length of the training of each replica, in episodes or steps, and how often agents learn.

    Raises:
        ValueError: for numbers below 1, and for none or both of `episodes` and `steps`.
    """

    episodes: Steps | None = None
    """Episodes that each replica plays, in all its worlds together; None with `steps`."""
    steps: Steps | None = None
    """Steps that each replica takes, W in each turn of W worlds; None with `episodes`."""
    worlds: Steps = 1
    """Worlds W of each replica; world b of the environment belongs to replica b // W."""
    update_every: Steps = 1
    """Turns k between updates; each learner then updates k times."""
    on_nan: OnNan = "stop"
    """The reaction to a loss, weight, reward or observation that is not finite, see
    `cprl.training.nan_check`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.episodes is None) == (self.steps is None):
            raise ValueError(
                f"schedule.episodes is {self.episodes} and steps {self.steps}; allowed: one of them"
            )

    @cached_property
    def length(self) -> Length:
        return Length.of(vars(self))

    def counted(self, episodes: int) -> int:
        """Return how many of a replica's episodes count; those that it plays while it waits for other
        replicas do not."""
        return episodes if self.length.is_of_steps else min(episodes, self.length.number)

    def is_over(self, episodes: Sequence[int], steps: int) -> bool:
        """Return whether a training is over, given the episodes that each replica has ended and the steps."""
        return self.length.is_over(episodes=min(episodes), steps=steps)

    def is_ending(self, episodes: Sequence[int], steps: int) -> bool:
        """Return whether a replica may end its last episode in the next turn, in which each of its worlds can
        end one; for a length in steps, whether the training is over."""
        if self.length.is_of_steps:
            return self.is_over(episodes, steps)
        return max(episodes) > self.length.number - self.worlds

    def refuse_rollouts(self, steps: int, name: str = "rollout_steps") -> None:
        """Raise a ValueError if `update_every` does not divide the steps of rollouts, called `name`."""
        if steps % self.update_every:
            raise ValueError(f"update_every is {self.update_every}; it must divide {name}, {steps}")
