"""What a training wants of the process that it runs in."""

import ctypes
import logging
import sys
from typing import Final

import torch

_M_TRIM_THRESHOLD: Final = -1
_M_MMAP_THRESHOLD: Final = -3
"""Names of settings in glibc's malloc.h."""
_MOST_KEPT: Final = 32 * 2**20
"""Bytes: glibc's highest threshold for memory of its own for an allocation (mallopt(3))."""


def prepare_process(seed: int) -> None:
    """What a training wants of its process: one torch thread, no denormals, a seeded generator, memory that
    is kept for the next step; TorchRL quiet, ours told.

    These networks are so small that a second thread costs more than it gives, up to a hundredfold on a busy
    machine; denormal numbers in Adam's moments of dead weights slow a long run by up to 1.9 times.
    """
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    _keep_freed_memory()
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    own = logging.getLogger("cprl")
    own.setLevel(logging.INFO)
    if not own.handlers:
        own.addHandler(logging.StreamHandler(sys.stdout))


def _keep_freed_memory() -> None:
    """Has glibc keep what a step frees for the next one, up to what its own adjustment would come to.

    Otherwise it depends on the layout of the heap whether its end is handed back to the system after a step
    and fetched again in the next, page by page.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _MOST_KEPT)
        mallopt(_M_TRIM_THRESHOLD, 2 * _MOST_KEPT)
