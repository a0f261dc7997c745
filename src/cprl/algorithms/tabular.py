"""Tabular Q-learning as an algorithm of a population."""

from dataclasses import dataclass
from typing import ClassVar

from cprl.commons.game import Game
from cprl.learners.settings import TabularSettings
from cprl.learners.tabular import table_network
from cprl.policies.tabular import TableNetwork


@dataclass(frozen=True, kw_only=True)
class Tabular:
    """Tabular Q-learning as the algorithm of a population's member; see `TabularLearner`."""

    settings: TabularSettings
    stochastic: ClassVar[bool] = False

    def network(self, game: Game) -> TableNetwork:
        """What an agent has tabulated, nothing at first.

        Raises:
            ValueError: for a game that tells more than the board is seen to be.
        """
        return table_network(game)
