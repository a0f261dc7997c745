"""Find NaN and infinite numbers in weights and other tensors."""

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor


def all_finite(tensors: Iterable[Tensor]) -> bool:
    """Return whether no number in some tensors, of any shapes and dtypes, is NaN or infinite."""
    floats = [tensor for tensor in tensors if tensor.is_floating_point() and tensor.numel()]
    if not floats:
        return True
    return bool(finite_lanes([tensor.reshape(1, -1) for tensor in floats]).item())


def finite_lanes(tensors: Sequence[Tensor]) -> Tensor:
    """Return for each lane whether none of its numbers is NaN or infinite, bool [L], on the CPU.

    Args:
        tensors: [L, ...] each; at least one has floating-point numbers.
    """
    tensors = [tensor.detach() for tensor in tensors if tensor.is_floating_point()]
    # A sum is finite only if all its terms are, and is computed fast. A sum of finite terms can overflow, so
    # the terms themselves are checked where a sum is not finite.
    sums = torch.stack([tensor.reshape(len(tensor), -1).sum(1) for tensor in tensors])
    are_finite = sums.isfinite().all(0).cpu()
    if not are_finite.all():
        by_tensor = torch.stack([tensor.reshape(len(tensor), -1).isfinite().all(1) for tensor in tensors])
        are_finite = by_tensor.all(0).cpu()
    return are_finite
