"""Devices and their free memory: what would fail only after hours, or without a word, is refused before
anything is allocated.

torch is imported where a device is asked for, so that the game, which does without, can use this too.
"""

from typing import TYPE_CHECKING, Annotated, Any

import psutil

from cprl.values import Where

if TYPE_CHECKING:
    import torch


def _is_device(value: Any) -> bool:
    import torch

    try:
        return (
            isinstance(value, str) and str(torch.device(value)) == value != "meta"
        )  # cuda:300 would become cuda:44
    except (RuntimeError, ValueError):
        return False


Device = Annotated[str, Where(_is_device, '"cpu", "cuda:0"')]


class TooLargeError(ValueError, MemoryError):
    """A request for more memory than is free; nothing has been allocated."""


def free_bytes(device: "str | torch.device" = "cpu") -> int:
    """Return how many bytes a device has free."""
    if str(device).startswith("cuda"):
        import torch

        return int(torch.cuda.mem_get_info(torch.device(device))[0])
    return int(psutil.virtual_memory().available)


def check_memory(what: str, needed: int, instead: str, *, device: "str | torch.device" = "cpu") -> None:
    """Refuse a request that would not fit into memory, before the system grants it and fails at the first
    write.

    Args:
        what: what takes the memory, in the plural.
        needed: the estimated bytes.
        instead: what to use in its place.
    """
    free = free_bytes(device)
    if needed > free:
        raise TooLargeError(f"{what} take {gib(needed)}; {gib(free)} are free: use {instead}")


def gib(size: int) -> str:
    """Return a number of bytes as text in GiB."""
    return f"{size / 2**30:,.2f} GiB" if size < 2**70 else f"more than {2**40:,} GiB"
