"""Losses of temporal-difference errors: the log-cosh loss, which neither torch nor TorchRL has, and `TDLoss`,
the base of cprl's own losses with one-step targets."""

from dataclasses import dataclass
from math import log
from typing import Any, ClassVar, Literal, Self, TypeAlias

from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.nn.functional import softplus
from torchrl.modules import QValueActor
from torchrl.objectives import DQNLoss, LossModule, ValueEstimators
from torchrl.objectives.utils import dispatch_value_estimator, distance_loss

from cprl.system.compat.torchrl import ReshapedLoss

TorchRLDistance: TypeAlias = Literal["l1", "l2", "smooth_l1"]
"""The loss functions that TorchRL has."""
Distance: TypeAlias = Literal["l1", "l2", "smooth_l1", "log_cosh"]
"""The loss functions of `td_distance`."""


def log_cosh(error: Tensor) -> Tensor:
    """Return ln cosh d for each error d of a tensor: about d^2 / 2 near 0, and abs(d) - ln 2 far from 0.

    It is computed as d + softplus(-2 d) - ln 2, which does not overflow; its derivative is tanh(d). In
    float32 both have a rounding error of about 1e-7. So for errors below 1e-3 the loss is mostly rounding
    error, but the derivative is still exact enough to learn from.

    Source: the loss "logcosh" of Keras 2.2.4 (`keras/losses.py`).
    """
    return error + softplus(-2.0 * error) - log(2)


def td_distance(value: Tensor, target: Tensor, name: str) -> Tensor:
    """Return the loss of each value, in the shape of `value`, by a loss function.

    Args:
        name: a `Distance`.
    """
    if name == "log_cosh":
        return log_cosh(value - target)
    return distance_loss(value, target, name)


class LogCoshDQNLoss(ReshapedLoss, DQNLoss):
    """TorchRL's `DQNLoss` with the log-cosh of the temporal-difference errors.

    With `loss_function="l1"` `DQNLoss` computes absolute errors; their log-cosh is that of the errors
    themselves, since it is an even function. The arguments are those of `DQNLoss`.
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
        """Return the log-cosh of absolute errors."""
        return log_cosh(losses)


class TDLoss(LossModule):
    """The base of losses whose targets are r + gamma times the next value, by TorchRL's TD(0) estimator."""

    @dataclass
    class _AcceptedKeys:
        """The entries that the loss reads, by the names under which `set_keys` renames them."""

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
        """Set the discount, e.g. `make_value_estimator(ValueEstimators.TD0, gamma=0.99)`."""
        dispatch_value_estimator(
            self,
            value_type or self.default_value_estimator,
            supported=(ValueEstimators.TD0,),
            tensor_keys=self._estimator_keys(),
            value_network=None,
            **hyperparams,
        )
        return self

    def outputs_of(
        self, name: str, weights: TensorDictBase, tensordict: TensorDictBase, **entries: Tensor
    ) -> Tensor:
        """Return the first output of a network of the loss, computed with given weights.

        Args:
            name: the attribute that holds the network.
            weights: the weights, e.g. those of the target.
            tensordict: has the entries that the network reads, except `entries`.
            entries: further entries that the network reads.
        """
        network = getattr(self, name)
        inputs = tensordict.select(*(key for key in network.in_keys if key not in entries)).update(entries)
        with weights.to_module(network, preserve_module_state=False):
            output: Tensor = network(inputs).get(network.out_keys[0])
        return output
