"""What a governor wants: a number of a period, or of a whole episode, see `Governor.objective`."""

from collections.abc import Callable
from typing import Any

import numpy as np

from cprl.commons.game import Game
from cprl.institutions import Governor
from cprl.measuring.social import equality
from cprl.values import Custom
from cprl.values.array_types import Float64


def welfare(governor: Governor, incomes: Any, steps: Any, stock: Any) -> Float64:
    """Return the objective of a governor for periods of T turns in which N agents have incomes R_i, [...].

    "income" is sum_i R_i / T, in apples per turn; "lowest_income" N min_i R_i / T, which equals it where all
    have the same; "income_times_equality" is `cprl.measuring.social.equality` times it, 0 where that is
    undefined. All are 0 where the stock is below `Governor.least_stock`.

    Args:
        governor: the governor.
        incomes: [..., N].
        steps: the turns T, [...].
        stock: the share of all sites that hold an apple at the end, [...].
    """
    played = np.maximum(steps, 1)
    if isinstance(governor.objective, Custom):
        wanted = np.asarray(governor.objective.make(incomes, steps), np.float64)
    elif governor.objective == "lowest_income":
        wanted = incomes.shape[-1] * incomes.min(-1) / played
    else:
        wanted = incomes.sum(-1) / played
        if governor.objective == "income_times_equality":
            wanted = wanted * np.nan_to_num(equality(incomes))
    return np.where(stock < governor.least_stock, 0.0, wanted)


def wanted_in(game: Game) -> Callable[[Any, Any, Any], Float64] | None:
    """Return the objective of a game's governor, as a function of incomes, turns and the apples left; None
    without a governor."""
    governor = game.governor
    if governor is None:
        return None
    return lambda incomes, steps, left: welfare(governor, incomes, steps, left / len(game.map.sites))
