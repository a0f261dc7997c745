"""Whether weights are numbers: NaN and infinite ones are found."""

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor


def all_finite(tensors: Iterable[Tensor]) -> bool:
    """Whether no number in tensors of any shapes and dtypes is NaN or infinite; reads each once."""
    floats = [tensor for tensor in tensors if tensor.is_floating_point() and tensor.numel()]
    if not floats:
        return True
    return bool(finite_lanes([tensor.reshape(1, -1) for tensor in floats]).item())


def finite_lanes(tensors: Sequence[Tensor]) -> Tensor:
    """Whether no number of a lane is NaN or infinite, bool [L], in the memory of the CPU.

    Args:
        tensors: of L lanes, [L, ...] each, at least one of floating-point numbers.
    """
    tensors = [tensor.detach() for tensor in tensors if tensor.is_floating_point()]
    # A sum is finite only if all its terms are; the terms are looked at where it is not, since the sum of
    # finite ones can exceed the largest number.
    sums = torch.stack([tensor.reshape(len(tensor), -1).sum(1) for tensor in tensors])
    sound = sums.isfinite().all(0).cpu()
    if not sound.all():
        each = torch.stack([tensor.reshape(len(tensor), -1).isfinite().all(1) for tensor in tensors])
        sound = each.all(0).cpu()
    return sound
