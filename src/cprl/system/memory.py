"""Devices and their free memory: what would not fit is refused before anything is allocated.

torch is imported where a device is asked for, so that the game, which does without, can use this too.
"""

from typing import TYPE_CHECKING, Annotated, Any, Final

import psutil

from cprl.values import Where

if TYPE_CHECKING:
    import torch


def _is_device(value: Any) -> bool:
    import torch

    try:
        return isinstance(value, str) and str(torch.device(value)) == value != "meta"  # cuda:300 becomes 44
    except (RuntimeError, ValueError):
        return False


Device = Annotated[str, Where(_is_device, '"cpu", "cuda:0"')]
_SMALL: Final = 2**20
"""Bytes that are not worth the question how many are free."""


class TooLargeError(ValueError, MemoryError):
    """What would take more memory than is free; nothing of it has been allocated."""


def free_bytes(device: "str | torch.device" = "cpu") -> int:
    if str(device).startswith("cuda"):
        import torch

        return int(torch.cuda.mem_get_info(torch.device(device))[0])
    return int(psutil.virtual_memory().available)


def check_memory(
    what: str, needed: int, instead: str, *, device: "str | torch.device" = "cpu", free: int | None = None
) -> None:
    """Refuses what would not fit: what takes the memory, in the plural, and how many bytes it takes,
    estimated.

    Args:
        instead: what to use in its place.
        free: how many bytes are free; None to ask the device.
    """
    if needed <= _SMALL:
        return
    free = free_bytes(device) if free is None else free
    if needed > free:
        raise TooLargeError(f"{what} take {gib(needed)}; {gib(free)} are free: use {instead}")


def gib(size: int) -> str:
    """A number of bytes in GiB, for people."""
    return f"{size / 2**30:,.2f} GiB" if size < 2**70 else f"more than {2**40:,} GiB"
