"""Matrix games: agents choose at once and are paid by a table, once or for several turns.

`MatrixGame` is a payoff table as a value; `prisoners_dilemma` and others are published ones.
Sources: Foerster et al. (2018), "Learning with Opponent-Learning Awareness", AAMAS; Leibo et al. (2017),
"Multi-agent Reinforcement Learning in Sequential Social Dilemmas", AAMAS.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from string import ascii_uppercase
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from stage_games import StageGame
from torch import Tensor

from cprl.values import MOST_NUMBER, refusal

_MOST_PAYOFFS: Final = 2**16
_MOST_NAMED: Final = 16
"""Joint actions that have a name each."""


@dataclass(frozen=True)
class MatrixGame(StageGame):
    """A game of N agents who choose among A actions each, at once, and are paid by a table.

    When it ends, see `StageGame`. Of each remembered joint action, the last one first, agents observe
    A**N + 1 numbers of which one is 1. Each agent sees joint actions from its own side: its own action first,
    then those of the following agents, cyclically. Of two agents with two actions, agent 0 sees the joint
    action (1, 0) as number 2 of 0..3, agent 1 as number 1. The number A**N stands for a turn before the
    first.
    """

    payoffs: Any
    """The payments of all N agents, float [A, ..., A, N]: an axis for the action of each agent, and their
    payoffs last; nested tuples, lists or an array."""

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "payoffs", _table(self.payoffs))

    @property
    def agents(self) -> int:
        """Return the number of agents N."""
        return np.ndim(self.payoffs) - 1

    @property
    def actions(self) -> int:
        """Return the number of actions A of each agent."""
        return len(self.payoffs)

    @property
    def joint_actions(self) -> tuple[str, ...]:
        """Return the joint actions of a small game in letters, that of agent 0 first: C and D in a social
        dilemma of two, where both are paid more if both choose action 0, else A and so on. None of a large
        game."""
        if self.actions**self.agents > _MOST_NAMED:
            return ()
        letters = "CD" if self._is_dilemma else ascii_uppercase[: self.actions]
        return tuple(map("".join, product(letters, repeat=self.agents)))

    @property
    def _is_dilemma(self) -> bool:
        """Return whether two agents with the same payoffs are paid more if both choose action 0, and one is
        tempted by action 1 or fears the other's."""
        payoffs = np.array(self.payoffs)
        if payoffs.shape != (2, 2, 2) or not (payoffs[..., 0] == payoffs[..., 1].T).all():
            return False
        (reward, sucker), (temptation, punishment) = payoffs[..., 0]
        is_better = reward > max(punishment, sucker)
        return bool(is_better and (temptation > reward or punishment > sucker))

    def tables(self, device: torch.device) -> "_Tables":
        joint = self.actions**self.agents
        agents = torch.arange(self.agents)
        after = (agents - agents[:, None]) % self.agents
        payoffs = torch.tensor(self.payoffs, dtype=torch.float32, device=device)
        return _Tables(
            torch.tensor(joint, device=device),
            payoffs.reshape(joint, self.agents),
            (self.actions ** (self.agents - 1 - after)).to(device),
        )

    def pay(self, tables: "_Tables", action: Tensor) -> tuple[Tensor, Tensor]:
        seen = (action[:, None] * tables.places).sum(-1)
        return tables.payoffs[seen[:, 0]], seen

    def observe(self, tables: "_Tables", memory: Tensor) -> Tensor:
        seen = torch.zeros(*memory.shape, len(tables.payoffs) + 1, device=memory.device)
        return seen.scatter_(-1, memory.unsqueeze(-1), 1.0).flatten(2)


class _Tables(NamedTuple):
    blank: Tensor
    """A**N, the number of a joint action before the first."""
    payoffs: Tensor
    """The payments of agents, [A**N, N], by the number of the joint action as agent 0 sees it."""
    places: Tensor
    """The weight of each agent's action (column) in the number that an agent (row) sees, [N, N]."""


def _table(payoffs: Any) -> tuple[Any, ...]:
    """Return payoffs as nested tuples of Python's floats."""
    name = "MatrixGame.payoffs"
    try:
        table = np.asarray(payoffs, np.float64)
    except (TypeError, ValueError, OverflowError):
        raise refusal(name, payoffs, "an array of numbers") from None
    *actions, agents = table.shape or (0,)
    if agents != len(actions) or len(set(actions)) != 1 or actions[0] < 2:
        raise ValueError(
            f"{name} has the shape {list(table.shape)}; allowed: [A, ..., A, N], N axes of A actions, at "
            "least 2, and the payoffs of the N agents"
        )
    if table.size > _MOST_PAYOFFS:
        raise ValueError(f"{name} has {table.size:,} numbers; allowed: up to {_MOST_PAYOFFS:,}")
    if not (np.abs(table) <= MOST_NUMBER).all():
        raise ValueError(f"{name} has {np.abs(table).max():g}; allowed: numbers up to {MOST_NUMBER:g}")
    return tuple(map(_nested_tuples, table.tolist()))


def _nested_tuples(value: Any) -> Any:
    return tuple(map(_nested_tuples, value)) if isinstance(value, list) else value


def prisoners_dilemma(
    *,
    reward: float = -1.0,
    sucker: float = -3.0,
    temptation: float = 0.0,
    punishment: float = -2.0,
    **clock: Any,
) -> MatrixGame:
    """Return the prisoner's dilemma; action 0 cooperates, 1 defects.

    By default the payoffs of Foerster et al. (2018), table 1. Leibo et al. (2017), figure 1, have 3, 0, 4, 1.
    Refuses others than temptation > reward > punishment > sucker.

    Args:
        reward: of both where both cooperate.
        sucker: of who cooperates alone.
        temptation: of who defects alone.
        punishment: of both where both defect.
        clock: turns, memory and continue_prob of a `StageGame`.
    """
    return _symmetric(
        ("temptation > reward > punishment > sucker",), clock, reward, sucker, temptation, punishment
    )


def stag_hunt(
    *,
    reward: float = 4.0,
    sucker: float = 0.0,
    temptation: float = 3.0,
    punishment: float = 1.0,
    **clock: Any,
) -> MatrixGame:
    """Return the stag hunt; action 0 hunts the stag, 1 the hare. Payoffs of Leibo et al. (2017), figure 1.

    Arguments are those of `prisoners_dilemma`, where to cooperate is to hunt the stag. Refuses others than
    reward > temptation > sucker and reward > punishment > sucker.
    """
    orders = "reward > temptation > sucker", "reward > punishment > sucker"
    return _symmetric(orders, clock, reward, sucker, temptation, punishment)


def chicken(
    *,
    reward: float = 3.0,
    sucker: float = 1.0,
    temptation: float = 4.0,
    punishment: float = 0.0,
    **clock: Any,
) -> MatrixGame:
    """Return chicken; action 0 swerves, 1 goes straight on. Payoffs of Leibo et al. (2017), figure 1.

    Arguments are those of `prisoners_dilemma`, where to cooperate is to swerve. Refuses others than
    temptation > reward > sucker > punishment.
    """
    return _symmetric(
        ("temptation > reward > sucker > punishment",), clock, reward, sucker, temptation, punishment
    )


def matching_pennies(*, stake: float = 1.0, **clock: Any) -> MatrixGame:
    """Return matching pennies; agent 0 wins where both show the same side, agent 1 where they do not.

    Payoffs of Foerster et al. (2018), table 2; the winner gets `stake`, above 0, and the other loses it.
    """
    if not stake > 0:
        raise refusal("stake", stake, "a number above 0")
    same = (stake, -stake)
    return MatrixGame(((same, same[::-1]), (same[::-1], same)), **clock)


def _symmetric(
    orders: Sequence[str],
    clock: dict[str, Any],
    reward: float,
    sucker: float,
    temptation: float,
    punishment: float,
) -> MatrixGame:
    """Return the game of these payoffs; raise a ValueError unless they are in these orders."""
    payoffs = {"reward": reward, "sucker": sucker, "temptation": temptation, "punishment": punishment}
    for order in orders:
        names = order.split(" > ")
        if not all(payoffs[one] > payoffs[other] for one, other in pairwise(names)):
            numbers = ", ".join(f"{name} {payoffs[name]:g}" for name in names)
            raise ValueError(f"the payoffs are {numbers}; allowed: {order}")
    cooperates = ((reward, reward), (sucker, temptation))
    defects = ((temptation, sucker), (punishment, punishment))
    return MatrixGame((cooperates, defects), **clock)
