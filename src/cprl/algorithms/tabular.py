"""Tabular Q-learning as an algorithm."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from cprl.algorithms.base import Algorithm, TrainingEngine
from cprl.commons.spaces import Spaces
from cprl.learners.base import Learner
from cprl.learners.settings import TabularSettings
from cprl.learners.tabular import TabularLearner, table_network
from cprl.policies.tabular import TableNetwork


@dataclass(frozen=True, kw_only=True)
class Tabular(Algorithm):
    """Tabular Q-learning; see `TabularLearner`."""

    settings: TabularSettings
    settings_kind: ClassVar[type[Any]] = TabularSettings

    def make_network(self, spaces: Spaces) -> TableNetwork:
        """The table of one agent, initially empty.

        Raises:
            ValueError: if agents observe more than ("agents", "observation").
        """
        return table_network(spaces)

    def make_learner(
        self, spaces: Spaces, *, agents: Sequence[int], engine: TrainingEngine = "compiled", **how: Any
    ) -> Learner:
        """See `Algorithm`; tables are neither compiled nor on a GPU."""
        self._check_settings()
        self._refuse_torchrl(engine)
        self.make_network(spaces)
        how.pop("device", None)
        return TabularLearner(spaces, agents=agents, settings=self.settings, **how)
