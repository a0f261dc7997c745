"""Tabular Q-learning, algorithm 1 of the study."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from cprl.algorithms.base import Algorithm, TrainingEngine
from cprl.commons.spaces import Spaces
from cprl.learners.lanes import Lanes
from cprl.learners.settings import TabularSettings
from cprl.learners.tabular import TabularMemory, TabularNetworks, table_network
from cprl.policies.tabular import TableNetwork


@dataclass(frozen=True, kw_only=True)
class Tabular(Algorithm):
    """Tabular Q-learning; see `cprl.learners.tabular`.

    Tables are neither compiled nor on a GPU.
    """

    settings: TabularSettings

    def make_network(self, spaces: Spaces) -> TableNetwork:
        return table_network(spaces)

    def make_memory(self, lanes: Lanes, network: Any, engine: TrainingEngine) -> Any:
        return TabularMemory(lanes, self.settings)

    def make_lane_networks(
        self, networks: Sequence[Any], targets: Any, lanes: Lanes, memory: Any, engine: TrainingEngine
    ) -> Any:
        return TabularNetworks(networks, memory, self.settings)
