"""Tags: who tagged whom, as a matrix that is logged now and then."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cprl.viewer.logger import RerunLogger

EVERY: Final = 10
"""Episodes from one matrix to the next."""
OVER: Final = 5
"""A matrix sums the tags of so many times `EVERY` episodes, the last ones."""


class Tags:
    """Sums the tags of the last episodes, over all replicas.

    Args:
        logger: where the matrices are logged.
        agents: the number of agents N.
    """

    def __init__(self, logger: RerunLogger, agents: int) -> None:
        self._logger = logger
        self._last = [np.zeros((agents, agents))]

    def add(self, tagged_by: NDArray[np.int64]) -> None:
        """Adds the tags of an episode of a replica, [N, N]: row tagged, column by whom."""
        self._last[-1] += tagged_by

    def on_episode(self, episode: int) -> None:
        """Logs the matrix if it is due after an episode, counted from 0, that all replicas have ended."""
        if (episode + 1) % EVERY == 0:
            self._logger.log_matrix("tags", np.sum(self._last, 0), ("tagged", "by whom"))
            self._last = [*self._last[1 - OVER :], np.zeros_like(self._last[0])]

    def state_dict(self) -> list[Any]:
        """The matrices that are summed."""
        return [own.tolist() for own in self._last]

    def load_state_dict(self, state: list[Any]) -> None:
        """Continues from a state that `state_dict` returned."""
        self._last = list(np.array(state, np.float64))
