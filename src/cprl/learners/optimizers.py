"""Optimisers for the weights of all lanes at once: how a gradient changes weights, and how it is clipped."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import torch
from torch import Tensor

from cprl.learners.settings import Optimizer


@dataclass(frozen=True, kw_only=True)
class UpdateRule:
    """An optimiser with its hyperparameters, gradient clipping, and how targets follow the weights."""

    optimizer: Optimizer = "adam"
    """The name of the optimiser."""
    learning_rate: float
    """The learning rate of the first step."""
    decays: bool = False
    """True if the learning rate changes from step to step."""
    adam_eps: float = 1e-8
    """The optimiser's epsilon, if it has one."""
    loss_share: float = 1.0
    """The factor by which losses are multiplied."""
    max_grad_norm: float | None = None
    """The norm to which each lane's gradient is clipped; None for no clipping."""
    tau: float | None = None
    """The fraction by which targets move towards the weights after each update; None for hard updates."""
    target_every_updates: int | None = None
    """Updates between copies of the weights to targets; None for copies by `copy_to_targets` alone."""

    @classmethod
    def of(cls, settings: Any, *, loss_share: float = 1.0) -> "UpdateRule":
        """Return the rule that an agent's settings say; fields that the settings lack keep their defaults."""
        names = ("optimizer", "learning_rate", "adam_eps", "max_grad_norm", "tau", "target_every_updates")
        fields = {name: getattr(settings, name) for name in names if hasattr(settings, name)}
        decays = getattr(settings, "learning_rate_end", None) is not None
        return cls(**fields, decays=decays, loss_share=loss_share)


BETA_1: Final = 0.9
BETA_2: Final = 0.999
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
    """Return torch's optimiser of the weights of one lane.

    Args:
        fused: whether torch takes its fused implementation, where there is one; None for torch's default.
    """
    rate = rule.learning_rate
    if rule.optimizer in RMSPROP_ALPHAS:
        alpha = RMSPROP_ALPHAS[rule.optimizer]
        return torch.optim.RMSprop(parameters, lr=rate, eps=rule.adam_eps, alpha=alpha)
    if rule.optimizer == "sgd":
        return torch.optim.SGD(parameters, lr=rate, fused=fused)
    optimizer_class = torch.optim.Adam if rule.optimizer == "adam" else torch.optim.AdamW
    return optimizer_class(parameters, lr=rate, eps=rule.adam_eps, fused=fused)


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
    """Change the weights of all lanes by one step of the optimiser, in place.

    The results are those of torch's optimisers, up to rounding.

    Args:
        weights: the weights of all lanes, [L, ...] each.
        gradients: their gradients, in the same order and shapes.
        means: running means of gradients; empty if the optimiser has none.
        squares: running means of squared gradients; empty if the optimiser has none.
        rate: the learning rate; in compiled code a number is a constant, a tensor is not.
        step_size: Adam's learning rate with bias correction.
        scale: the bias correction of the root of Adam's `squares`.
    """
    if rule.max_grad_norm is not None:
        gradients = clip_by_norm(gradients, rule.max_grad_norm)
    if rule.optimizer in WITH_MEAN:
        for weight, gradient, mean, square in zip(weights, gradients, means, squares, strict=True):
            if rule.optimizer == "adamw":
                weight.mul_(1 - rate * ADAMW_DECAY)
            mean.mul_(BETA_1).add_(gradient, alpha=1 - BETA_1)
            square.mul_(BETA_2).addcmul_(gradient, gradient, value=1 - BETA_2)
            weight.sub_(step_size * mean / (square.sqrt() * scale + rule.adam_eps))
    elif rule.optimizer in RMSPROP_ALPHAS:
        alpha = RMSPROP_ALPHAS[rule.optimizer]
        for weight, gradient, square in zip(weights, gradients, squares, strict=True):
            square.mul_(alpha).addcmul_(gradient, gradient, value=1 - alpha)
            weight.sub_(rate * gradient / (square.sqrt() + rule.adam_eps))
    else:
        for weight, gradient in zip(weights, gradients, strict=True):
            if isinstance(rate, Tensor):
                weight.sub_(rate * gradient)
            else:  # rounds once instead of twice
                weight.sub_(gradient, alpha=rate)


def clip_by_norm(gradients: Sequence[Tensor], max_norm: float) -> list[Tensor]:
    """Return gradients of all weights, [L, ...] each, scaled down in lanes whose gradient has a norm above
    `max_norm`."""
    squares = [gradient.reshape(len(gradient), -1).square().sum(1) for gradient in gradients]
    norms = torch.stack(squares).sum(0).sqrt()
    scales = (max_norm / (norms + 1e-6)).clamp(max=1.0)
    return [gradient * scales.reshape(-1, *[1] * (gradient.ndim - 1)) for gradient in gradients]
