"""Optimisers of many lanes: the formulas of `torch.optim` for weights with a lane axis."""

from collections.abc import Iterable, Sequence
from typing import Final

import torch
from torch import Tensor

from cprl.learners.settings import Optimizer

BETA_1, BETA_2 = 0.9, 0.999
"""Adam's decay rates (Kingma and Ba 2015, torch's defaults)."""
ADAMW_DECAY: Final = 0.01
"""AdamW's weight decay (Loshchilov and Hutter 2019, torch's default)."""
RMSPROP_ALPHAS: Final = {"rmsprop": 0.99, "keras_rmsprop": 0.9}
"""RMSprop's decay rate: torch's default, and that of Keras 2.2.4."""

WITH_MEAN: Final = ("adam", "adamw")
"""Optimisers with a running mean of gradients."""
WITH_SQUARE: Final = ("adam", "adamw", *RMSPROP_ALPHAS)
"""Optimisers with a running mean of squared gradients."""


def torch_optimizer(
    name: Optimizer, parameters: Iterable[Tensor], *, learning_rate: float, eps: float
) -> torch.optim.Optimizer:
    """The optimiser of one lane."""
    if name == "adam":
        return torch.optim.Adam(parameters, lr=learning_rate, eps=eps, fused=True)
    if name == "adamw":
        return torch.optim.AdamW(parameters, lr=learning_rate, eps=eps, fused=True)
    if name in RMSPROP_ALPHAS:
        return torch.optim.RMSprop(parameters, lr=learning_rate, eps=eps, alpha=RMSPROP_ALPHAS[name])
    return torch.optim.SGD(parameters, lr=learning_rate, fused=True)


def change_weights(
    name: Optimizer,
    weights: Sequence[Tensor],
    gradients: Sequence[Tensor],
    means: Sequence[Tensor],
    squares: Sequence[Tensor],
    *,
    step_size: Tensor,
    scale: Tensor,
    learning_rate: float,
    eps: float,
) -> None:
    """One step of all lanes, in place.

    Args:
        name: the optimiser.
        weights: [L, ...] each.
        gradients: of each weight.
        means: running means of gradients; empty if the optimiser has none.
        squares: running means of squared gradients, likewise.
        step_size: Adam's learning rate with bias correction.
        scale: the bias correction of the root of Adam's `squares`.
        learning_rate: the learning rate of the settings.
        eps: added to denominators.
    """
    if name in WITH_MEAN:
        for weight, slope, mean, square in zip(weights, gradients, means, squares, strict=True):
            if name == "adamw":
                weight.mul_(1 - learning_rate * ADAMW_DECAY)
            mean.mul_(BETA_1).add_(slope, alpha=1 - BETA_1)
            square.mul_(BETA_2).addcmul_(slope, slope, value=1 - BETA_2)
            weight.sub_(step_size * mean / (square.sqrt() * scale + eps))
    elif name in RMSPROP_ALPHAS:
        alpha = RMSPROP_ALPHAS[name]
        for weight, slope, square in zip(weights, gradients, squares, strict=True):
            square.mul_(alpha).addcmul_(slope, slope, value=1 - alpha)
            weight.sub_(learning_rate * slope / (square.sqrt() + eps))
    else:
        for weight, slope in zip(weights, gradients, strict=True):
            weight.sub_(slope, alpha=learning_rate)


def shortened(gradients: Sequence[Tensor], longest: float) -> list[Tensor]:
    """Gradients [L, ...] of all weights, scaled down for lanes whose gradient norm exceeds `longest`."""
    squares = [slope.reshape(len(slope), -1).square().sum(1) for slope in gradients]
    norms = torch.stack(squares).sum(0).sqrt()
    scales = (longest / (norms + 1e-6)).clamp(max=1.0)
    return [slope * scales.reshape(-1, *[1] * (slope.ndim - 1)) for slope in gradients]
