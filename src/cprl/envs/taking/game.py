"""TakingGame: a game of people who share a resource, as something that agents play."""

from dataclasses import KW_ONLY, dataclass, fields
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from cprl.checks import NONE, Check, check_fields, count, either, instance, is_number
from cprl.theory.sharing import SharingGame

if TYPE_CHECKING:
    from cprl.envs.taking.env import TakingEnv

_MOST_TOTALS: Final = 2**22
"""How many totals there may be when agents choose from levels."""


@dataclass(frozen=True)
class TakingGame:
    """A game in which each of n agents chooses, all at once, how much it takes of what they share.

    Agents are paid `SharingGame.payoffs`. They choose one of `levels` evenly spaced amounts from 0 to
    `most_each`. Where it is played for several turns, agents
    observe what they took in the last ones. An episode of one turn terminates. One of several is truncated:
    its end is a clock that nobody sees, so agents learn as if it went on; with a `continue_prob` below 1 it
    terminates where no further turn follows.

    A recipe holds games whose worth is a `PowerWorth`. A worth of your own, e.g. a `CallableWorth`, can be
    played; in an experiment the game is then a `Custom` of a function that makes it.

    Raises:
        ValueError: names the field, what came and what is allowed.
    """

    sharing: SharingGame
    """What agents are paid, and how many they are; e.g. `cprl.theory.herders(5)`."""
    _: KW_ONLY
    levels: int = 21
    """From how many evenly spaced amounts an agent chooses, 0 the first."""
    most: float | None = None
    """The most that an agent can take in a turn. By default twice what it takes in the symmetric equilibrium,
    or what the game itself allows, `SharingGame.most_each`, if that is less."""
    turns: int = 1
    """Turns of an episode, at most."""
    memory: int | None = None
    """Of how many of the last turns agents observe what was taken, each as three numbers; by default 1, and 0
    in a game of one turn, in which the observation is the number 1."""
    continue_prob: float = 1.0
    """The probability that a further turn follows, above 0."""

    def __post_init__(self) -> None:
        check_fields(self, _CHECKS)
        name = "TakingGame"
        if self.turns == 1 and self.continue_prob < 1:
            raise ValueError(
                f"{name}.continue_prob is {self.continue_prob}; allowed in a game of one turn: 1.0"
            )
        limit = self.sharing.most_each
        if self.most is None and self.sharing.nash_total <= 0:
            raise ValueError(
                f"{name}.most is None; allowed in a game in which nobody gains by taking: a number above 0"
            )
        if self.most is not None and limit is not None and self.most > limit:
            raise ValueError(f"{name}.most is {self.most:g}; allowed: up to sharing.most_each, {limit:g}")
        if self.agents * (self.levels - 1) >= _MOST_TOTALS:
            raise ValueError(
                f"{name}.levels is {self.levels}; allowed for {self.agents:,} agents: so many that they have "
                f"fewer than {_MOST_TOTALS:,} totals"
            )

    @property
    def agents(self) -> int:
        """The number of agents N."""
        return self.sharing.agents

    @property
    def most_each(self) -> float:
        """The most that an agent can take: `most`, or what its default means."""
        if self.most is not None:
            return self.most
        twice = 2 * self.sharing.nash_total / self.agents
        return twice if self.sharing.most_each is None else min(twice, self.sharing.most_each)

    @property
    def amounts(self) -> tuple[float, ...]:
        """What an agent takes by its action 0, 1 and so on."""
        return tuple(np.linspace(0, self.most_each, self.levels).tolist())

    @property
    def remembered(self) -> int:
        """The number of turns that agents observe: `memory`, or what its default means."""
        return int(self.turns > 1) if self.memory is None else self.memory

    def to_config(self) -> dict[str, Any]:
        """Its fields."""
        return {own.name: getattr(self, own.name) for own in fields(self)}

    def make(self, worlds: int, seed: int, device: Any, *, first_world: int = 0) -> "TakingEnv":
        """Its environment, so many worlds; see `TakingEnv`."""
        from cprl.envs.taking.env import TakingEnv

        return TakingEnv(self, worlds, seed=seed, device=device, first_world=first_world)


_MOST: Final = 1e12


def _is_positive(value: Any) -> bool:
    return is_number(value, 0, _MOST) and value > 0


_CHECKS: Final[dict[str, Check]] = {
    "sharing": instance(SharingGame, "a cprl.theory.SharingGame, e.g. herders(5)"),
    "levels": count(2, 2**16),
    "most": either(NONE, Check(_is_positive, f"a number above 0, up to {_MOST:g}")),
    "turns": count(1),
    "memory": either(NONE, count(0, 64)),
    "continue_prob": Check(lambda value: is_number(value, 0, 1) and value > 0, "a number above 0, at most 1"),
}
