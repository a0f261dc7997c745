"""What a governor wants: a number of a period, or of a whole episode, see `Governor.objective`."""

from typing import Any

import numpy as np

from cprl.commons.game import Game
from cprl.measuring.social import equality
from cprl.values import Custom
from cprl.values.array_types import Float64


def welfare(game: Game, incomes: Any, steps: Any, stock: Any) -> Float64:
    """Return the objective of a game's governor for periods of T turns, [...], in which N agents have incomes
    R_i.

    "income" is sum_i R_i / T, in apples per turn; "lowest_income" N min_i R_i / T, which equals it where all
    have the same; "income_times_equality" is `cprl.measuring.social.equality` times it, 0 where that is
    undefined. All are 0 where the stock is below `Governor.least_stock`.

    Args:
        game: a game with a governor.
        incomes: [..., N].
        steps: the turns T, [...], at least 1.
        stock: the apples on the board at the end, [...].
    """
    governor = game.governor
    assert governor is not None
    if isinstance(governor.objective, Custom):
        wanted = np.asarray(governor.objective.make(incomes, steps), np.float64)
    elif governor.objective == "lowest_income":
        wanted = incomes.shape[-1] * incomes.min(-1) / steps
    else:
        wanted = incomes.sum(-1) / steps
        if governor.objective == "income_times_equality":
            wanted = wanted * np.nan_to_num(equality(incomes))
    return np.where(stock / len(game.map.sites) < governor.least_stock, 0.0, wanted)
