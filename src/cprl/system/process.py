"""Settings of the process that trains: threads, signals, memory, and folders of compiled code."""

import ctypes
import logging
import os
import platform
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from threading import Thread, current_thread, main_thread
from types import FrameType
from typing import Final

from cprl.system.output import OUT

_M_TRIM_THRESHOLD: Final = -1
_M_MMAP_THRESHOLD: Final = -3
"""Parameters of mallopt, from glibc's malloc.h."""
_MAX_THRESHOLD_BYTES: Final = 32 * 2**20
"""glibc's highest value of M_MMAP_THRESHOLD, in bytes (mallopt(3))."""


def prepare_process(seed: int, *, threads: int = 1) -> None:
    """Prepare the process for a training.

    Seed torch's global generator, set the number of torch's threads, flush denormal numbers to zero, make
    glibc reuse freed memory, keep what torch compiles in `cache_folder` unless
    $TORCHINDUCTOR_CACHE_DIR says where, and log warnings of TorchRL and messages of cprl.

    The networks are so small that a second thread slows them down, up to a hundredfold on a busy machine.
    Large minibatches of many worlds are the exception, if no other program needs the cores. Denormal numbers
    in Adam's moments of dead weights slow a long run by a factor of up to 1.9.
    """
    import torch

    torch.manual_seed(seed)
    torch.set_num_threads(threads)
    torch.set_flush_denormal(True)
    _keep_freed_memory()
    _keep_compiled_code()
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    logger = logging.getLogger("cprl")
    logger.setLevel(logging.INFO)
    if not logger.handlers:
        logger.addHandler(logging.StreamHandler(OUT))


@contextmanager
def on_signals(handler: Callable[[int], object], *signals: signal.Signals) -> Iterator[None]:
    """Call a function with the number of each signal that arrives in the block.

    Python handles signals in the main thread only; in other threads this does nothing.

    Args:
        handler: the function.
        signals: the signals to handle; by default SIGINT and SIGTERM.
    """

    def handle(signal_number: int, frame: FrameType | None) -> None:
        handler(signal_number)

    previous_handlers = {}
    if current_thread() is main_thread():
        for number in signals or (signal.SIGINT, signal.SIGTERM):
            previous_handlers[number] = signal.signal(number, handle)
    try:
        yield
    finally:
        for number, previous in previous_handlers.items():
            signal.signal(number, previous)


def obey_parent() -> None:
    """Make this process obey its parent, which writes into its standard input: each byte acts as a SIGTERM,
    and the end of the pipe ends the process."""
    Thread(target=_obey, args=(sys.stdin.fileno(),), daemon=True).start()


def _obey(pipe: int) -> None:
    while os.read(pipe, 1):
        if sys.platform == "win32":  # os.kill would end the process without its handler
            signal.raise_signal(signal.SIGTERM)
        else:
            os.kill(os.getpid(), signal.SIGTERM)
    os._exit(1)


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch compute in one thread within the block, as trainings do: results differ in their last bits
    with the number of threads."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@cache
def cpu() -> str:
    """Return the name of this machine's processor; results may differ in their last bits on another."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines():
            name, _, value = line.partition(":")
            if name.strip() == "model name":
                return value.strip()
    return platform.processor() or platform.machine()


def _keep_freed_memory() -> None:
    """Make glibc keep the memory that a training step frees, up to the limit of its dynamic adjustment.

    Otherwise, depending on the layout of the heap, glibc may return its end to the system after each step and
    request it again in the next, page by page.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _MAX_THRESHOLD_BYTES)
        mallopt(_M_TRIM_THRESHOLD, 2 * _MAX_THRESHOLD_BYTES)


def _keep_compiled_code() -> None:
    """Store code that torch compiles in cprl's cache folder, beside the compiled rules of the game. Torch's
    default, the folder for temporary files, is emptied when many machines start."""
    folder = cache_folder() / "torch"
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            os.environ.setdefault("TORCHINDUCTOR_CACHE_DIR", str(folder))


def cache_folder() -> Path:
    """Return the folder of compiled code: $CPRL_CACHE, or else "cprl" in the user's cache folder."""
    if "CPRL_CACHE" in os.environ:
        return Path(os.environ["CPRL_CACHE"])
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "cprl"
