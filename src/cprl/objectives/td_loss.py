"""TDLoss: what losses share whose targets bootstrap by one step of temporal differences."""

from typing import Any, Self

from tensordict.utils import NestedKey
from torchrl.objectives import LossModule, ValueEstimators
from torchrl.objectives.utils import dispatch_value_estimator


class TDLoss(LossModule):
    """A loss with TorchRL's TD(0) estimator, over the entries that `_estimator_keys` names."""

    default_value_estimator = ValueEstimators.TD0
    _in_keys: list[NestedKey] | None

    def _estimator_keys(self) -> dict[str, NestedKey]:
        raise NotImplementedError

    def _forward_value_estimator_keys(self, **_: Any) -> None:
        self._in_keys = None
        if self._value_estimator is not None:
            self._value_estimator.set_keys(**self._estimator_keys())

    def make_value_estimator(self, value_type: Any = None, **hyperparams: Any) -> Self:
        """Sets the discount, e.g. `make_value_estimator(ValueEstimators.TD0, gamma=0.99)`.

        Raises:
            NotImplementedError: for another estimator than TD0.
        """
        dispatch_value_estimator(
            self,
            self.default_value_estimator if value_type is None else value_type,
            supported=(ValueEstimators.TD0,),
            tensor_keys=self._estimator_keys(),
            value_network=None,
            **hyperparams,
        )
        return self
