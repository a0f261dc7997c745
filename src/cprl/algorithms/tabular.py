"""Tabular Q-learning, algorithm 1 of the study."""

from dataclasses import dataclass

from cprl.algorithms.base import Algorithm, TrainingEngine
from cprl.commons.spaces import Spaces
from cprl.learners.lanes import Lanes
from cprl.learners.protocol import AnyLearner
from cprl.learners.settings import TabularSettings
from cprl.learners.tabular import TabularLearner, table_network
from cprl.policies.tabular import TableNetwork


@dataclass(frozen=True, kw_only=True)
class Tabular(Algorithm):
    """Tabular Q-learning; see `TabularLearner`."""

    settings: TabularSettings

    def make_network(self, spaces: Spaces) -> TableNetwork:
        return table_network(spaces)

    def make_learner(self, lanes: Lanes, engine: TrainingEngine = "compiled") -> AnyLearner:
        # Tables are neither compiled nor on a GPU.
        self.refuse_torchrl(engine)
        self.make_network(lanes.spaces)
        return TabularLearner(lanes, self.settings)
