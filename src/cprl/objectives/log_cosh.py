"""The logarithm of the hyperbolic cosine of an error, which neither torch nor TorchRL has as a loss."""

from math import log
from typing import Any, Final

from tensordict.nn import TensorDictModule
from torch import Tensor
from torch.nn.functional import softplus
from torchrl.objectives import DQNLoss
from torchrl.objectives.utils import distance_loss

from cprl.compat import ReshapedLoss

LOG_COSH: Final = "log_cosh"
"""Its name among loss functions."""
TORCHRL_DISTANCES: Final = ("l1", "l2", "smooth_l1")
"""The loss functions that TorchRL has."""
DISTANCES: Final = (*TORCHRL_DISTANCES, LOG_COSH)
"""The loss functions of `distance`."""


def log_cosh(error: Tensor) -> Tensor:
    """ln cosh of each error d, float of any shape: about d^2 / 2 near 0 and abs(d) - ln 2 far from it.

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

    Args:
        value_network: see `DQNLoss`.
        how: its other arguments but `loss_function`.
    """

    def __init__(self, value_network: TensorDictModule, **how: Any) -> None:
        super().__init__(value_network, loss_function="l1", **how)

    def reshape_each(self, losses: Tensor) -> Tensor:
        """See `ReshapedLoss`."""
        return log_cosh(losses)
