"""Settings of the process in which a training runs, and the type of processor that it runs on."""

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
    """Prepares the process for a training.

    Seeds torch's global generator, sets the number of torch's threads, flushes denormal numbers to zero,
    makes glibc reuse freed memory, keeps what torch compiles in `cache_folder` unless
    $TORCHINDUCTOR_CACHE_DIR says where, and logs warnings of TorchRL and messages of cprl.

    The networks are so small that a second thread slows them down, up to a hundredfold on a busy machine,
    unless minibatches are large, of many worlds, and nothing else wants the cores. Denormal numbers in Adam's
    moments of dead weights slow a long run by a factor of up to 1.9.
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
def at_signals(call: Callable[[int], object], *numbers: signal.Signals) -> Iterator[None]:
    """Call a function with its number at a signal in the block, by default at SIGINT and SIGTERM.

    Python handles signals in the main thread alone; in other threads handlers stay as they are.
    """

    def handle(number: int, frame: FrameType | None) -> None:
        call(number)

    handled = (numbers or (signal.SIGINT, signal.SIGTERM)) if current_thread() is main_thread() else ()
    usual = {number: signal.signal(number, handle) for number in handled}
    try:
        yield
    finally:
        for number, handler in usual.items():
            signal.signal(number, handler)


def obey_parent() -> None:
    """Make this process obey the one at the other end of its standard input, a pipe: each byte is a SIGTERM,
    and it ends when nobody is left to write any."""
    Thread(target=_obey, args=(sys.stdin.fileno(),), daemon=True).start()


def _obey(pipe: int) -> None:
    while os.read(pipe, 1):
        if sys.platform == "win32":  # where os.kill ends the process at once, without its handler
            signal.raise_signal(signal.SIGTERM)
        else:
            os.kill(os.getpid(), signal.SIGTERM)
    os._exit(1)


@contextmanager
def one_thread() -> Iterator[None]:
    """Lets torch compute in one thread, as trainings do: the last bits of products depend on their number."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@cache
def cpu() -> str:
    """The type of this machine's processor; numbers may differ in the last bits on another."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines():
            name, _, value = line.partition(":")
            if name.strip() == "model name":
                return value.strip()
    return platform.processor() or platform.machine()


def _keep_freed_memory() -> None:
    """Makes glibc keep the memory that a step frees, up to the limit of glibc's own dynamic adjustment.

    Otherwise, depending on the layout of the heap, glibc may return its end to the system after each step and
    request it again in the next, page by page.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _MAX_THRESHOLD_BYTES)
        mallopt(_M_TRIM_THRESHOLD, 2 * _MAX_THRESHOLD_BYTES)


def _keep_compiled_code() -> None:
    """Makes torch keep compiled code where the rules' is, and not in the folder for temporary files, which
    many machines empty when they start."""
    folder = cache_folder() / "torch"
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            os.environ.setdefault("TORCHINDUCTOR_CACHE_DIR", str(folder))


def cache_folder() -> Path:
    """$CPRL_CACHE, or the folder cprl in the user's cache folder."""
    if "CPRL_CACHE" in os.environ:
        return Path(os.environ["CPRL_CACHE"])
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "cprl"
