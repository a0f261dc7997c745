"""How a gradient changes the weights of lanes: optimisers of torch, for all lanes at once, and clipping."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import torch
from torch import Tensor

from cprl.learners.settings import Optimizer


@dataclass(frozen=True, kw_only=True)
class UpdateRule:
    """How a gradient changes weights: the optimiser, clipping, and how targets follow."""

    optimizer: Optimizer = "adam"
    """The name of the optimiser of `torch.optim`."""
    learning_rate: float
    falls: bool = False
    """Whether the learning rate changes from step to step."""
    adam_eps: float = 1e-8
    """The optimiser's epsilon, if it has one."""
    loss_share: float = 1.0
    """A factor of each loss."""
    max_grad_norm: float | None = None
    """The norm to which each lane's gradient is clipped; None for no clipping."""
    tau: float | None = None
    """The fraction by which targets move towards the weights after each update; None for hard updates."""
    target_every_updates: int | None = None
    """Updates between copies of the weights to targets; None for copies by `copy_to_targets` alone."""

    @classmethod
    def of(cls, settings: Any, *, loss_share: float = 1.0) -> "UpdateRule":
        """That of the hyperparameters of an agent, as far as they say."""
        names = ("optimizer", "learning_rate", "adam_eps", "max_grad_norm", "tau", "target_every_updates")
        said = {name: getattr(settings, name) for name in names if hasattr(settings, name)}
        falls = getattr(settings, "learning_rate_end", None) is not None
        return cls(**said, falls=falls, loss_share=loss_share)


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
    rule: UpdateRule, parameters: Iterable[Tensor], *, fused: bool | None = True
) -> torch.optim.Optimizer:
    """The optimiser of one lane; `fused` where torch has such a form of it, None for torch's default."""
    name, rate, eps = rule.optimizer, rule.learning_rate, rule.adam_eps
    if name in RMSPROP_ALPHAS:
        return torch.optim.RMSprop(parameters, lr=rate, eps=eps, alpha=RMSPROP_ALPHAS[name])
    if name == "sgd":
        return torch.optim.SGD(parameters, lr=rate, fused=fused)
    kind = torch.optim.Adam if name == "adam" else torch.optim.AdamW
    return kind(parameters, lr=rate, eps=eps, fused=fused)


def change_weights(
    rule: UpdateRule,
    weights: Sequence[Tensor],
    gradients: Sequence[Tensor],
    means: Sequence[Tensor],
    squares: Sequence[Tensor],
    *,
    rate: float | Tensor,
    step_size: Tensor,
    scale: Tensor,
) -> None:
    """One step of all lanes, in place.

    Args:
        weights: [L, ...] each.
        means: running means of gradients; empty if the optimiser has none.
        squares: running means of squared gradients, likewise.
        rate: the learning rate; a number is a constant of compiled code.
        step_size: Adam's learning rate with bias correction.
        scale: the bias correction of the root of Adam's `squares`.
    """
    if rule.max_grad_norm is not None:
        gradients = clip_by_norm(gradients, rule.max_grad_norm)
    name, eps = rule.optimizer, rule.adam_eps
    if name in WITH_MEAN:
        for weight, slope, mean, square in zip(weights, gradients, means, squares, strict=True):
            if name == "adamw":
                weight.mul_(1 - rate * ADAMW_DECAY)
            mean.mul_(BETA_1).add_(slope, alpha=1 - BETA_1)
            square.mul_(BETA_2).addcmul_(slope, slope, value=1 - BETA_2)
            weight.sub_(step_size * mean / (square.sqrt() * scale + eps))
    elif name in RMSPROP_ALPHAS:
        alpha = RMSPROP_ALPHAS[name]
        for weight, slope, square in zip(weights, gradients, squares, strict=True):
            square.mul_(alpha).addcmul_(slope, slope, value=1 - alpha)
            weight.sub_(rate * slope / (square.sqrt() + eps))
    else:
        for weight, slope in zip(weights, gradients, strict=True):
            if isinstance(rate, Tensor):
                weight.sub_(rate * slope)
            else:  # rounds once
                weight.sub_(slope, alpha=rate)


def clip_by_norm(gradients: Sequence[Tensor], max_norm: float) -> list[Tensor]:
    """Gradients [L, ...] of all weights, scaled down for lanes whose gradient norm exceeds `max_norm`."""
    squares = [slope.reshape(len(slope), -1).square().sum(1) for slope in gradients]
    norms = torch.stack(squares).sum(0).sqrt()
    scales = (max_norm / (norms + 1e-6)).clamp(max=1.0)
    return [slope * scales.reshape(-1, *[1] * (slope.ndim - 1)) for slope in gradients]
