"""Schedule: how long a training lasts, and in which rhythm its agents learn."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

from cprl.runs.length import Length
from cprl.values import Steps, Value

OnNan = Literal["stop", "continue"]
"""What a training does when a number is not finite: "stop" ends it by a `NotFiniteError`; "continue" warns
once of each agent and trains on."""


@dataclass(frozen=True, kw_only=True)
class Schedule(Value, stored=False, called="schedule"):
    """How long each replica is trained, in episodes or in steps, and in which rhythm.

    Raises:
        ValueError: for numbers below 1, and for none or both of `episodes` and `steps`.
    """

    episodes: Steps | None = None
    """Episodes that each replica plays, in all its worlds together; or say `steps`."""
    steps: Steps | None = None
    """Steps that each replica takes, a turn of W worlds being W; or say `episodes`."""
    worlds: Steps = 1
    """Worlds W of each replica; world b of the environment belongs to replica b // W."""
    update_every: Steps = 1
    """Turns k after which each learner updates, then k times."""
    on_nan: OnNan = "stop"
    """Whether the training stops where a loss, weight, reward or observation is not finite, see
    `cprl.training.finite`."""

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
        """Return how many episodes of a replica count that has ended so many: those that it plays on until
        the others have played theirs do not."""
        return episodes if self.length.is_of_steps else min(episodes, self.length.number)

    def is_over(self, episodes: Sequence[int], steps: int) -> bool:
        """Return whether a training is over whose replicas have each ended so many episodes, in so many
        steps."""
        return self.length.is_over(episodes=min(episodes), steps=steps)

    def is_ending(self, episodes: Sequence[int], steps: int) -> bool:
        """Return whether a replica may end its last episode in the next turn, in which each of its worlds can
        end one; of so many steps, whether they are over."""
        if self.length.is_of_steps:
            return self.is_over(episodes, steps)
        return max(episodes) > self.length.number - self.worlds

    def refuse_rollouts(self, steps: int, name: str = "rollout_steps") -> None:
        """Raise a ValueError for rollouts of so many steps, called `name`, that `update_every` does not
        divide."""
        if steps % self.update_every:
            raise ValueError(f"update_every is {self.update_every}; it must divide {name}, {steps}")
