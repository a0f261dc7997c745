"""Losses by one step of temporal differences: ln cosh of the error, which neither torch nor TorchRL has, and
what losses of our own share whose targets bootstrap so."""

from dataclasses import dataclass
from math import log
from typing import Any, ClassVar, Final, Self

from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.nn.functional import softplus
from torchrl.modules import QValueActor
from torchrl.objectives import DQNLoss, LossModule, ValueEstimators
from torchrl.objectives.utils import dispatch_value_estimator, distance_loss

from cprl.system.compat import ReshapedLoss

LOG_COSH: Final = "log_cosh"
"""Its name among loss functions."""
TORCHRL_DISTANCES: Final = ("l1", "l2", "smooth_l1")
"""The loss functions that TorchRL has."""
DISTANCES: Final = (*TORCHRL_DISTANCES, LOG_COSH)
"""The loss functions of `distance`."""


def log_cosh(error: Tensor) -> Tensor:
    """ln cosh of each error d, a tensor of any shape: about d^2 / 2 near 0 and abs(d) - ln 2 far from it.

    Computed as d + softplus(-2 d) - ln 2, which does not overflow. Its derivative is tanh(d). In float32 both
    have a rounding error of about 1e-7, so the loss of an error below 1e-3 is hardly more than noise, its
    derivative is not.

    Source: the loss "logcosh" of Keras 2.2.4 (`keras/losses.py`).
    """
    return error + softplus(-2.0 * error) - log(2)


def distance(value: Tensor, target: Tensor, name: str) -> Tensor:
    """TorchRL's `distance_loss`, which reduces nothing, for each name in `DISTANCES`."""
    if name == LOG_COSH:
        return log_cosh(value - target)
    one: Tensor = distance_loss(value, target, name)
    return one


class LogCoshDQNLoss(ReshapedLoss, DQNLoss):
    """TorchRL's `DQNLoss` with the log-cosh of the temporal-difference errors.

    log-cosh is even: it is that of the absolute error, which `DQNLoss` computes for `loss_function="l1"`.
    """

    def __init__(
        self,
        value_network: QValueActor | nn.Module,
        *,
        delay_value: bool = True,
        double_dqn: bool = False,
        action_space: str = "categorical",
        reduction: str = "mean",
    ) -> None:
        super().__init__(
            value_network,
            loss_function="l1",
            delay_value=delay_value,
            double_dqn=double_dqn,
            action_space=action_space,
            reduction=reduction,
        )

    def reshape_each(self, losses: Tensor) -> Tensor:
        return log_cosh(losses)


class TDLoss(LossModule):
    """A loss with TorchRL's TD(0) estimator, over the entries that `tensor_keys` names."""

    @dataclass
    class _AcceptedKeys:
        """The entries by the names that `set_keys` takes."""

        action: NestedKey = "action"
        reward: NestedKey = "reward"
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"

    default_value_estimator = ValueEstimators.TD0
    estimated: ClassVar[tuple[str, ...]] = ("reward", "done", "terminated")
    """The names among `tensor_keys` that the estimator reads."""

    def _estimator_keys(self) -> dict[str, NestedKey]:
        return {name: getattr(self.tensor_keys, name) for name in self.estimated}

    def _forward_value_estimator_keys(self, **_: Any) -> None:
        if self._value_estimator is not None:
            self._value_estimator.set_keys(**self._estimator_keys())

    def make_value_estimator(self, value_type: Any = None, **hyperparams: Any) -> Self:
        """Sets the discount, e.g. `make_value_estimator(ValueEstimators.TD0, gamma=0.99)`."""
        dispatch_value_estimator(
            self,
            self.default_value_estimator if value_type is None else value_type,
            supported=(ValueEstimators.TD0,),
            tensor_keys=self._estimator_keys(),
            value_network=None,
            **hyperparams,
        )
        return self

    def outputs_of(
        self, name: str, weights: TensorDictBase, tensordict: TensorDictBase, **entries: Tensor
    ) -> Tensor:
        """The first output of a network of this name with these weights.

        Args:
            tensordict: has the entries that the network reads, but for those given.
        """
        network = getattr(self, name)
        seen = tensordict.select(*(key for key in network.in_keys if key not in entries)).update(entries)
        with weights.to_module(network, preserve_module_state=False):
            output: Tensor = network(seen).get(network.out_keys[0])
        return output
