"""Matrix games: agents choose at once and are paid by a table, once or for several turns.

`MatrixGame` is a payoff table as a value, `prisoners_dilemma` and others are published ones, and `MatrixEnv`
plays B worlds of one.
Sources: Foerster et al. (2018), "Learning with Opponent-Learning Awareness", AAMAS; Leibo et al. (2017),
"Multi-agent Reinforcement Learning in Sequential Social Dilemmas", AAMAS.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar, Final, TypedDict, Unpack

import numpy as np
import torch
from torch import Tensor

from cprl.envs.stage_games import StageEnv, StageGame
from cprl.values import MOST_NUMBER, refusal

_MOST_PAYOFFS: Final = 2**16


@dataclass(frozen=True)
class MatrixGame(StageGame):
    """A game of N agents who choose among A actions each, at once, and are paid by a table; where it is
    played for several turns, agents observe the last joint actions, each as A**N + 1 numbers. When it ends,
    see `StageGame`.
    """

    payoffs: Any
    """What all N agents are paid, float [A, ..., A, N]: an axis for the action of each agent, and their
    payoffs last; nested tuples, lists or an array."""

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "payoffs", _table(self.payoffs))

    @property
    def agents(self) -> int:
        """The number of agents N."""
        return np.ndim(self.payoffs) - 1

    @property
    def actions(self) -> int:
        """The number of actions A of each agent."""
        return len(self.payoffs)

    def make(self, worlds: int, seed: int, device: Any, *, first_world: int = 0) -> "MatrixEnv":
        """Its environment, so many worlds; see `MatrixEnv`."""
        return MatrixEnv(self, worlds, seed=seed, device=device, first_world=first_world)


def _table(payoffs: Any) -> tuple[Any, ...]:
    """Payoffs as nested tuples of Python's floats."""
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
    return tuple(map(nested_tuples, table.tolist()))


def nested_tuples(value: Any) -> Any:
    """Return lists in lists as tuples in tuples."""
    return tuple(map(nested_tuples, value)) if isinstance(value, list) else value


class Clock(TypedDict, total=False):
    """How long a matrix game lasts and what agents remember of it, see `MatrixGame`."""

    turns: int
    memory: int | None
    continue_prob: float


def prisoners_dilemma(
    *,
    reward: float = -1.0,
    sucker: float = -3.0,
    temptation: float = 0.0,
    punishment: float = -2.0,
    **clock: Unpack[Clock],
) -> MatrixGame:
    """The prisoner's dilemma; action 0 cooperates, 1 defects.

    By default the payoffs of Foerster et al. (2018), table 1. Leibo et al. (2017), figure 1, have 3, 0, 4, 1.
    Refuses others than temptation > reward > punishment > sucker.

    Args:
        reward: of both where both cooperate.
        sucker: of who cooperates alone.
        temptation: of who defects alone.
        punishment: of both where both defect.
    """
    _check_order(temptation=temptation, reward=reward, punishment=punishment, sucker=sucker)
    return _symmetric(reward, sucker, temptation, punishment, clock)


def stag_hunt(
    *,
    reward: float = 4.0,
    sucker: float = 0.0,
    temptation: float = 3.0,
    punishment: float = 1.0,
    **clock: Unpack[Clock],
) -> MatrixGame:
    """The stag hunt; action 0 hunts the stag, 1 the hare. Payoffs of Leibo et al. (2017), figure 1.

    Arguments are those of `prisoners_dilemma`, where to cooperate is to hunt the stag. Refuses others than
    reward > temptation > sucker and reward > punishment > sucker.
    """
    _check_order(reward=reward, temptation=temptation, sucker=sucker)
    _check_order(reward=reward, punishment=punishment, sucker=sucker)
    return _symmetric(reward, sucker, temptation, punishment, clock)


def chicken(
    *,
    reward: float = 3.0,
    sucker: float = 1.0,
    temptation: float = 4.0,
    punishment: float = 0.0,
    **clock: Unpack[Clock],
) -> MatrixGame:
    """Chicken; action 0 swerves, 1 goes straight on. Payoffs of Leibo et al. (2017), figure 1.

    Arguments are those of `prisoners_dilemma`, where to cooperate is to swerve. Refuses others than
    temptation > reward > sucker > punishment.
    """
    _check_order(temptation=temptation, reward=reward, sucker=sucker, punishment=punishment)
    return _symmetric(reward, sucker, temptation, punishment, clock)


def matching_pennies(*, stake: float = 1.0, **clock: Unpack[Clock]) -> MatrixGame:
    """Matching pennies; agent 0 wins where both show the same side, agent 1 where they do not.

    Payoffs of Foerster et al. (2018), table 2; the winner gets `stake`, above 0, and the other loses it.
    """
    if not stake > 0:
        raise refusal("stake", stake, "a number above 0")
    same, other = (stake, -stake), (-stake, stake)
    return MatrixGame(((same, other), (other, same)), **clock)


def _symmetric(
    reward: float, sucker: float, temptation: float, punishment: float, clock: Clock
) -> MatrixGame:
    both_cooperate, both_defect = (reward, reward), (punishment, punishment)
    one_defects = (sucker, temptation), (temptation, sucker)
    return MatrixGame(((both_cooperate, one_defects[0]), (one_defects[1], both_defect)), **clock)


def _check_order(**payoffs: float) -> None:
    """Raise a ValueError unless each payoff is above the next."""
    if not all(one > other for one, other in pairwise(payoffs.values())):
        came = ", ".join(f"{name} {value:g}" for name, value in payoffs.items())
        raise ValueError(f"the payoffs are {came}; allowed: {' > '.join(payoffs)}")


class MatrixEnv(StageEnv):
    """B worlds of a matrix game; entries as in `StageEnv`.

    Of each remembered joint action, the last one first, agents observe A**N + 1 numbers of which one is 1.
    Each agent sees joint actions from its own side: its own action first, then those of the following
    agents, cyclically. Of two agents with two actions, agent 0 sees the joint action (1, 0) as number 2 of
    0..3, agent 1 as number 1. The number A**N stands for a turn before the first.
    """

    memory_name: ClassVar[str] = "joint"
    game: MatrixGame

    def prepare(self) -> Tensor:
        agents, actions = self.game.agents, self.game.actions
        self._none = actions**agents
        payoffs = torch.tensor(self.game.payoffs, dtype=torch.float32, device=self.device)
        self._payoffs = payoffs.reshape(self._none, agents)
        """What agents are paid, [A**N, N], by the number of the joint action as agent 0 sees it."""
        after = (torch.arange(agents) - torch.arange(agents)[:, None]) % agents
        self._places = (actions ** (agents - 1 - after)).to(self.device)
        """By which each agent's action (column) counts in the number that an agent (row) sees, [N, N]."""
        return torch.tensor(self._none, device=self.device)

    def pay(self, action: Tensor) -> tuple[Tensor, Tensor]:
        seen = (action[:, None] * self._places).sum(-1)
        return self._payoffs[seen[:, 0]], seen

    def observe(self, memory: Tensor) -> Tensor:
        seen = torch.zeros(*memory.shape, self._none + 1, device=self.device)
        return seen.scatter_(-1, memory.unsqueeze(-1), 1.0).flatten(2)
