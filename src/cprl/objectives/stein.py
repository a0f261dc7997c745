"""Stein variational gradient: how particles move towards a density that is known up to a factor."""

from math import log

import torch
from torch import Tensor

_SMALLEST_WIDTH = 1e-6


def stein_direction(particles: Tensor, score: Tensor) -> Tensor:
    """The direction in which particles move so that they come to be distributed like a density.

    Particle i moves by the mean over j of k(x_j, x_i) s(x_j) + grad_{x_j} k(x_j, x_i), with the kernel
    k(x, y) = exp(-|x - y|^2 / h) and the median heuristic h = median(|x - y|^2) / log(M + 1). The first term
    drives them to high density, the second apart.

    Source: Liu and Wang, "Stein Variational Gradient Descent" (2016), which samplers learn as of Feng, Wang
    and Liu, "Learning to Draw Samples with Amortized Stein Variational Gradient Descent" (2017).

    Args:
        particles: M of them, float [..., M, P].
        score: s, the gradient of the logarithm of the density at each, [..., M, P].

    Returns:
        Float [..., M, P], without a gradient of its own.
    """
    with torch.no_grad():
        apart = particles.unsqueeze(-2) - particles.unsqueeze(-3)  # [..., j, i, P], x_j - x_i
        squared = apart.square().sum(-1)
        count = particles.shape[-2]
        width = squared.flatten(-2).sort(-1).values[..., (count * count) // 2] / log(count + 1)
        width = width.clamp(min=_SMALLEST_WIDTH)[..., None, None]
        kernel = torch.exp(-squared / width)
        drive = (kernel.unsqueeze(-1) * score.unsqueeze(-2)).mean(-3)
        repulsion = (-2 / width * kernel).unsqueeze(-1) * apart
        return drive + repulsion.mean(-3)
