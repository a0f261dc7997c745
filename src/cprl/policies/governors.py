"""How a governor decides: by a rule of thumb, by a constant, or by the network of a `LaneActor`."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import torch
from torch import Tensor, nn

from cprl.commons.game import Game
from cprl.commons.spaces import Spaces
from cprl.institutions import Governor
from cprl.institutions.institution import Amount
from cprl.policies.actors import LaneActor
from cprl.values import Share, Value


@dataclass(frozen=True, kw_only=True)
class StockRule(Value):
    """A governor that goes by the stock: the more apples are left, the more it allows.

    The number is the option nearest to f times the highest one for a quota, and to 1 - f times it for a tax
    or for sanctions; f is 0 up to a stock of `lower`, 1 from a stock of `upper` on, and linear in between. By
    default the quota is proportional to the stock.

    Source: the harvest control rules of fisheries, in which the catch is a constant fraction of the stock or
    falls to 0 at a threshold: Deroba and Bence, "A review of harvest policies: understanding relative
    performance of control rules" (Fisheries Research 94, 2008).
    """

    lower: Share = 0.0
    """The share of all sites that hold an apple up to which nothing is allowed."""
    upper: Share = 1.0
    """The share from which on everything is."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.lower >= self.upper:
            raise ValueError(f"StockRule.lower is {self.lower:g}; allowed: less than upper, {self.upper:g}")

    def check(self, governor: Governor) -> None:
        """Raise a ValueError for a governor that does not see the stock."""
        if "stock" not in governor.sees:
            raise ValueError(f'Governor.sees is {governor.sees}; allowed for a StockRule: "stock" among them')

    def choose(self, governor: Governor, features: Tensor) -> Tensor:
        """Return the options for B worlds, int64 [B]; `features`: float [B, S]."""
        stock = features[:, governor.sees.index("stock")]
        allowed = ((stock - self.lower) / (self.upper - self.lower)).clamp(0, 1)
        wanted = allowed if governor.sets == "quota.share" else 1 - allowed
        options = features.new_tensor(governor.options)
        return (options - wanted[:, None] * options[-1]).abs().argmin(1)


@dataclass(frozen=True)
class Constant(Value):
    """A governor that always puts the same number in force.

    Args:
        number: one of its options.
    """

    number: Amount

    def check(self, governor: Governor) -> None:
        """Raise a ValueError for a governor without this option."""
        if self.number not in governor.options:
            raise ValueError(f"Constant.number is {self.number:g}; allowed: one of {governor.options}")

    def choose(self, governor: Governor, features: Tensor) -> Tensor:
        """Return the option for B worlds, int64 [B]; `features`: float [B, S]."""
        return torch.full((len(features),), governor.options.index(self.number), device=features.device)


ScriptedGovernor: TypeAlias = StockRule | Constant
"""A governor that does not learn: it decides by what it sees in this turn alone."""


def governor_spaces(game: Game) -> Spaces:
    """Return what the governor of a game sees and decides; it counts as the agent after the last one."""
    assert game.governor is not None
    return Spaces(
        agents=game.agents + 1,
        observation_shape=(len(game.governor.sees),),
        observation_dtype="float32",
        observation_scale=1.0,
        actions=len(game.governor.options),
    )


class GovernorActor(nn.Module):
    """Decides for B worlds at once. It decides first in the first turn from `from_turn` on that is a multiple
    of `Governor.every_steps`, then every so many turns.

    Args:
        governor: the governor that decides.
        decider: chooses its options: a `LaneActor` by a network, a `ScriptedGovernor` by a rule.
        from_turn: the turn from which on it decides, the first turn being 0; until its first decision the
            first option is in force.
    """

    def __init__(
        self, governor: Governor, decider: LaneActor | ScriptedGovernor, *, from_turn: int = 0
    ) -> None:
        super().__init__()
        self.governor = governor
        self.by: Any = decider  # a part of the names in checkpoints
        self.from_turn = from_turn
        self.turns = 0
        """The turns so far."""
        self.options_in_force: Tensor | None = None
        """The index of each world's option, int64 [B]; None before the first turn."""
        self.last_features: Tensor | None = None
        """What the governor saw when it decided last, float32 [B, S]; None before its first decision."""

    @property
    def is_due(self) -> bool:
        """Return whether it decides in the coming turn."""
        return self.turns >= self.from_turn and self.turns % self.governor.every_steps == 0

    def decide(self, features: Tensor) -> Tensor:
        """Return the options in force in the coming turn, int64 [B]; `features`: float32 [B, S]."""
        if self.options_in_force is None:
            self.options_in_force = torch.zeros(len(features), dtype=torch.int64, device=features.device)
        if self.is_due:
            self.last_features = features
            self.options_in_force = self._choose(features)
        self.turns += 1
        return self.options_in_force

    def _choose(self, features: Tensor) -> Tensor:
        """Return the options for B worlds.

        A network decides for all replicas x worlds; where one world is played, its decision in the first
        replica counts.
        """
        if not isinstance(self.by, LaneActor):
            return self.by.choose(self.governor, features)
        worlds = self.by.replicas * self.by.worlds
        return self.by.choose(features.expand(worlds, -1)[:, None])[: len(features), 0]

    def get_extra_state(self) -> dict[str, Any]:
        return {"turns": self.turns, "rule": self.options_in_force, "seen": self.last_features}

    def set_extra_state(self, state: Mapping[str, Any]) -> None:
        self.turns = int(state["turns"])
        self.options_in_force = state["rule"]
        self.last_features = state["seen"]
