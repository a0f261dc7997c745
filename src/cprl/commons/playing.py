"""harvests: a whole episode in every world of a batch, by whoever chooses the actions."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cprl.commons.batch import Batch, turn_of


def harvests(batch: Batch, choose: Callable[[Batch], NDArray[Any]]) -> NDArray[np.float64]:
    """The collective harvest of the next episode of each world, float64 [B], in apples.

    Args:
        batch: B worlds, without institutions, since these are paid for actions.
        choose: the actions of all agents, int64 [B, N], asked for in each turn until all worlds have ended.
    """
    output = batch.begin(batch.new_output())
    total = np.zeros(batch.size)
    while not turn_of(output).done.all():
        output = batch.play(choose(batch), output)
        total += turn_of(output).harvest.sum(1, dtype=np.float64)
    return total
