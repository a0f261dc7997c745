"""Games of people who share a resource: agents choose at once how much they take, once or several times."""

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, fields
from typing import Annotated, Any, Final, NamedTuple

import numpy as np
import torch
from sharing_games import Above0, SharingGame, from_table
from stage_games import StageGame
from torch import Tensor

from cprl.values import Range

_MOST_TOTALS: Final = 2**22
"""The totals that there may be when agents choose from levels."""
OBSERVED: Final = ("played", "own", "total")
"""The numbers by which an agent observes a turn: 1 if there was such a turn, the share that it took of the
most that it can take, and the share that all took of the most that all can take."""


@dataclass(frozen=True)
class TakingGame(StageGame):
    """A `SharingGame` that agents play: all choose at once how much they take of what they share.

    Agents are paid `SharingGame.payoffs`. They choose one of `levels` evenly spaced amounts from 0 to
    `most_each`. Of each remembered turn, the last one first, agents observe the numbers of `OBSERVED`, all
    0 for a turn before the first. When it ends, see `StageGame`.

    A recipe holds games whose worth is a `PowerWorth`. A worth of your own, e.g. a `CallableWorth`, can be
    played; in an experiment the game is then a `Custom` of a function that makes it. A recipe has `sharing`
    as a table of its fields, of which the game can be made too.
    """

    sharing: SharingGame
    """The payments and the number of agents; e.g. `herders(5)`."""
    _: KW_ONLY
    levels: Annotated[int, Range(2, 2**16)] = 21
    """The number of evenly spaced amounts from which an agent chooses, 0 the first."""
    most: Above0 | None = None
    """The most that an agent can take in a turn. By default twice what it takes in the symmetric equilibrium,
    or what the game itself allows, `SharingGame.most_each`, if that is less."""

    def __post_init__(self) -> None:
        if isinstance(self.sharing, Mapping):
            object.__setattr__(self, "sharing", from_table(SharingGame, self.sharing, "TakingGame.sharing"))
        super().__post_init__()
        limit = self.sharing.most_each
        if self.most is None and self.sharing.nash_total <= 0:
            raise ValueError(
                "TakingGame.most is None; allowed where nobody gains by taking: a number above 0"
            )
        if self.most is not None and limit is not None and self.most > limit:
            raise ValueError(f"TakingGame.most is {self.most:g}; allowed: up to sharing.most_each, {limit:g}")
        if self.agents * (self.levels - 1) >= _MOST_TOTALS:
            raise ValueError(
                f"TakingGame.levels is {self.levels}; allowed for {self.agents:,} agents: so many that they "
                f"have fewer than {_MOST_TOTALS:,} totals"
            )

    def to_config(self) -> dict[str, Any]:
        """Return the arguments that make it, as a recipe holds them."""
        arguments = {field.name: getattr(self, field.name) for field in fields(self)}
        return {**arguments, "sharing": self.sharing.to_config()}

    @property
    def agents(self) -> int:
        """Return the number of agents N."""
        return self.sharing.agents

    @property
    def actions(self) -> int:
        """Return the number of actions: `levels`."""
        return self.levels

    @property
    def most_each(self) -> float:
        """Return the most that an agent can take: `most`, or what its default means."""
        if self.most is not None:
            return self.most
        twice = 2 * self.sharing.nash_total / self.agents
        return twice if self.sharing.most_each is None else min(twice, self.sharing.most_each)

    @property
    def amounts(self) -> tuple[float, ...]:
        """Return what an agent takes by its action 0, 1 and so on."""
        return tuple(np.linspace(0, self.most_each, self.levels).tolist())

    def tables(self, device: torch.device) -> "_Tables":
        totals = self.agents * (self.levels - 1) + 1
        taken = np.linspace(0, self.agents * self.most_each, totals)
        gains = np.vectorize(self.sharing.worth.at, otypes=[np.float64])(taken) - self.sharing.cost
        return _Tables(
            torch.zeros(len(OBSERVED), device=device),
            torch.tensor(self.amounts, dtype=torch.float64, device=device),
            torch.from_numpy(gains).to(device),
        )

    def pay(self, tables: "_Tables", action: Tensor) -> tuple[Tensor, Tensor]:
        total = action.sum(-1, keepdim=True)
        reward = tables.amounts[action] * tables.gains[total] + self.sharing.payment
        share = action / (self.levels - 1)
        total_share = total / ((self.levels - 1) * self.agents)
        turn = torch.stack((torch.ones_like(share), share, total_share.expand_as(share)), -1).float()
        return reward.float(), turn.clamp(0, 1)

    def observe(self, tables: "_Tables", memory: Tensor) -> Tensor:
        return memory.flatten(2).clone()


class _Tables(NamedTuple):
    blank: Tensor
    """Zeros, the numbers of `OBSERVED` of a turn before the first."""
    amounts: Tensor
    """The amount that an agent takes by each action, float64: rewards are computed in double precision."""
    gains: Tensor
    """The worth of a unit beyond its cost, by the sum of all levels."""
