"""Published matrix games by name, with their payoffs as arguments.

Sources: Foerster et al. (2018), "Learning with Opponent-Learning Awareness", AAMAS; Leibo et al. (2017),
"Multi-agent Reinforcement Learning in Sequential Social Dilemmas", AAMAS.
"""

from itertools import pairwise
from typing import Any

from cprl import arguments
from cprl.checks import MOST_NUMBER
from cprl.envs.matrix.game import MatrixGame


def prisoners_dilemma(
    *,
    reward: float = -1.0,
    sucker: float = -3.0,
    temptation: float = 0.0,
    punishment: float = -2.0,
    turns: int = 1,
    memory: int | None = None,
    continue_prob: float = 1.0,
) -> MatrixGame:
    """The prisoner's dilemma; action 0 cooperates, 1 defects.

    By default the payoffs of Foerster et al. (2018), table 1. Leibo et al. (2017), figure 1, have 3, 0, 4, 1.

    Args:
        reward: of both where both cooperate.
        sucker: of who cooperates alone.
        temptation: of who defects alone.
        punishment: of both where both defect.
        turns: see `MatrixGame`.
        memory: see `MatrixGame`.
        continue_prob: see `MatrixGame`.

    Raises:
        ValueError: unless temptation > reward > punishment > sucker.
    """
    _check_order(temptation=temptation, reward=reward, punishment=punishment, sucker=sucker)
    payoffs = _symmetric(reward, sucker, temptation, punishment)
    return MatrixGame(payoffs, turns=turns, memory=memory, continue_prob=continue_prob)


def stag_hunt(
    *,
    reward: float = 4.0,
    sucker: float = 0.0,
    temptation: float = 3.0,
    punishment: float = 1.0,
    turns: int = 1,
    memory: int | None = None,
    continue_prob: float = 1.0,
) -> MatrixGame:
    """The stag hunt; action 0 hunts the stag, 1 the hare. Payoffs of Leibo et al. (2017), figure 1.

    Args:
        reward: of both where both hunt the stag.
        sucker: of who hunts the stag alone.
        temptation: of who hunts the hare alone.
        punishment: of both where both hunt the hare.
        turns: see `MatrixGame`.
        memory: see `MatrixGame`.
        continue_prob: see `MatrixGame`.

    Raises:
        ValueError: unless reward > temptation > sucker and reward > punishment > sucker.
    """
    _check_order(reward=reward, temptation=temptation, sucker=sucker)
    _check_order(reward=reward, punishment=punishment, sucker=sucker)
    payoffs = _symmetric(reward, sucker, temptation, punishment)
    return MatrixGame(payoffs, turns=turns, memory=memory, continue_prob=continue_prob)


def chicken(
    *,
    reward: float = 3.0,
    sucker: float = 1.0,
    temptation: float = 4.0,
    punishment: float = 0.0,
    turns: int = 1,
    memory: int | None = None,
    continue_prob: float = 1.0,
) -> MatrixGame:
    """Chicken; action 0 swerves, 1 goes straight on. Payoffs of Leibo et al. (2017), figure 1.

    Args:
        reward: of both where both swerve.
        sucker: of who swerves alone.
        temptation: of who goes on alone.
        punishment: of both where both go on.
        turns: see `MatrixGame`.
        memory: see `MatrixGame`.
        continue_prob: see `MatrixGame`.

    Raises:
        ValueError: unless temptation > reward > sucker > punishment.
    """
    _check_order(temptation=temptation, reward=reward, sucker=sucker, punishment=punishment)
    payoffs = _symmetric(reward, sucker, temptation, punishment)
    return MatrixGame(payoffs, turns=turns, memory=memory, continue_prob=continue_prob)


def matching_pennies(
    *, stake: float = 1.0, turns: int = 1, memory: int | None = None, continue_prob: float = 1.0
) -> MatrixGame:
    """Matching pennies; agent 0 wins where both show the same side, agent 1 where they do not.

    Payoffs of Foerster et al. (2018), table 2.

    Args:
        stake: what the winner gets and the other loses, above 0.
        turns: see `MatrixGame`.
        memory: see `MatrixGame`.
        continue_prob: see `MatrixGame`.
    """
    arguments.number("stake", stake, low=0, high=MOST_NUMBER, above=True, allowed="a number above 0")
    same, other = (stake, -stake), (-stake, stake)
    return MatrixGame(((same, other), (other, same)), turns=turns, memory=memory, continue_prob=continue_prob)


def _symmetric(reward: float, sucker: float, temptation: float, punishment: float) -> Any:
    return (
        ((reward, reward), (sucker, temptation)),
        ((temptation, sucker), (punishment, punishment)),
    )


def _check_order(**payoffs: Any) -> None:
    """Raises a ValueError unless each payoff is above the next."""
    for name, value in payoffs.items():
        arguments.number(name, value, low=-MOST_NUMBER, high=MOST_NUMBER, allowed="a number")
    values = list(payoffs.values())
    if not all(one > other for one, other in pairwise(values)):
        came = ", ".join(f"{name} {value:g}" for name, value in payoffs.items())
        raise ValueError(f"the payoffs are {came}; allowed: {' > '.join(payoffs)}")
