"""Cache compiled functions on disk: Numba's cache, made safe for many processes and for damaged files.

Files have a checksum, one process compiles while others wait, and a child process does the compiling. This
uses private parts of Numba; `tests/system/test_compat.py` has a test for each.
"""

import gc
import hashlib
import os
import pickle
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from io import BytesIO
from pathlib import Path
from types import FunctionType
from typing import Any, Final

import numba
from filelock import FileLock

from cprl.system.libraries import relying_on
from cprl.system.process import obey_parent

KEY_FILE: Final = "key.py"
"""The name of the file that stands for the source of the functions in a cache folder."""

_SETTINGS: Final[Any] = numba.config
_CHECKSUM_BYTES: Final = 16
_WAIT_S: Final = 300.0
"""The seconds that a process waits for another one that compiles the same function, before it compiles it
itself."""


@contextmanager
def numba_cache_in(folder: Path) -> Iterator[None]:
    """Set the folder of Numba's cache while the context is open.

    Numba documents this setting only as an environment variable, which it reads when it is imported.
    """
    with relying_on("numba", "numba.config.CACHE_DIR"):
        previous_folder = _SETTINGS.CACHE_DIR
    _SETTINGS.CACHE_DIR = str(folder)
    try:
        yield
    finally:
        _SETTINGS.CACHE_DIR = previous_folder


def compile_with_disk_cache(
    function: FunctionType, *, in_child: Callable[[], Any] | None = None, **options: Any
) -> Any:
    """Return a function that Numba compiles at its first call, or reads from its cache on disk.

    If several processes need it at the same time, one compiles it, and the others wait and then read it. If
    the cache cannot be written or read, e.g. on a full disk, each process compiles it. The checksums of files
    are compared before they are read, because Numba would run damaged machine code.

    Args:
        function: the plain function.
        in_child: called in a child process, returns the same compiled function there. The child then fills
            the cache while this process waits. So this process answers Ctrl-C, which it could not do itself
            while LLVM runs, for up to a minute.
        options: options of `numba.njit`.
    """
    try:
        dispatcher: Any = numba.njit(**options, cache=True)(function)
    except RuntimeError:  # no folder for it is writable
        return numba.njit(**options)(function)
    with relying_on("numba", "Dispatcher.compile and its cache"):
        compile_for = dispatcher.compile
        numba_cache = dispatcher._cache
        folder = Path(dispatcher.stats.cache_path)
        cache_file = numba_cache._cache_file
        cache_file._open_for_write = _with_checksum(cache_file._open_for_write)

    def compiled_once(types: Any) -> Any:
        try:
            _remove_damaged(folder, f"*.{function.__name__}-*.nb[ic]")
            if in_child is not None and not _is_child and not _is_cached(dispatcher, types):
                _compile_in_child(in_child, types)
            lock_path = folder / f"{function.__name__}.lock"
            with _lock_unless_cached(lock_path, cached=f"*.{function.__name__}-*.nbi"):
                return compile_for(types)
        except OSError as error:
            _warn(folder, str(error))
            numba_cache.disable()
            return compile_for(types)  # takes no time if only writing the file failed

    dispatcher.compile = compiled_once
    return dispatcher


def _with_checksum(open_for_write: Callable[[str], Any]) -> Callable[[str], Any]:
    """Return Numba's function that opens a cache file for writing, changed so that it appends a checksum.

    Numba does not read the checksum.
    """

    @contextmanager
    def open_with_checksum(path: str) -> Iterator[BytesIO]:
        content = BytesIO()
        yield content
        with open_for_write(path) as file:
            file.write(content.getvalue() + _checksum(content.getvalue()))

    return open_with_checksum


def _checksum(content: bytes) -> bytes:
    return hashlib.blake2b(content, digest_size=_CHECKSUM_BYTES).digest()


def _remove_damaged(folder: Path, pattern: str) -> None:
    """Remove all cache files of a function if one of them is damaged, and warn (RuntimeWarning) of it."""
    paths = sorted(folder.glob(pattern))
    damaged = [str(path) for path in paths if not _is_intact(path)]
    if damaged:
        for path in paths:
            path.unlink(missing_ok=True)
        warnings.warn(
            f"{', '.join(damaged)}: damaged, and removed; what it held is compiled again",
            RuntimeWarning,
            stacklevel=3,
        )


def _is_intact(path: Path) -> bool:
    """Return whether the checksum of a cache file is right."""
    try:
        content = path.read_bytes()
    except FileNotFoundError:  # another process has just removed it, which does no harm
        return True
    return content[-_CHECKSUM_BYTES:] == _checksum(content[:-_CHECKSUM_BYTES])


def _is_cached(dispatcher: Any, types: Any) -> bool:
    """Return whether the machine code of a function for arguments of these types can be read from disk."""
    with relying_on("numba", "the cache of a Dispatcher"):
        numba_cache = dispatcher._cache
        codegen = dispatcher.targetctx.codegen
        index_key = numba_cache._index_key
        load = numba_cache._cache_file.load
    try:
        return load(index_key(types, codegen())) is not None
    except Exception:  # a damaged file can raise anything
        return False


_is_child = False
"""True in a child process that compiles for its parent."""


def _compile_in_child(in_child: Callable[[], Any], types: Any) -> None:
    """Let a child process compile a function for arguments of these types, and store it in the cache.

    If the child fails, nothing is stored. `in_child`: returns the function in the child process.
    """
    start = "from cprl.system.jit.disk_cache import compile_for_parent; compile_for_parent()"
    command = [sys.executable, "-c", f"import signal; signal.signal(signal.SIGINT, signal.SIG_IGN); {start}"]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    quiet = subprocess.DEVNULL
    try:
        child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=quiet, stderr=quiet, env=env)
    except OSError:  # e.g. where Python is part of another program
        return
    pipe = child.stdin
    assert pipe is not None
    try:
        with suppress(OSError):  # the child may end before it has read everything
            pipe.write(pickle.dumps((in_child, types)))
            pipe.flush()
        child.wait()
    finally:
        child.kill()
        child.wait()
        with suppress(OSError):
            pipe.close()


def compile_for_parent() -> None:
    """Compile, in a child process, the function for which the parent asks through standard input.

    The child ends when its parent ends.
    """
    global _is_child
    _is_child = True
    in_child, types = pickle.load(sys.stdin.buffer)
    obey_parent()
    gc.disable()  # a compilation leaves few cycles, and looking for them takes a tenth of its time
    in_child().compile(types)


@contextmanager
def _lock_unless_cached(path: Path, *, cached: str) -> Iterator[None]:
    """Hold a lock among processes in the context, unless the function is cached already.

    The context also opens without the lock: if the file system has no locks, or after `_WAIT_S` seconds.

    Args:
        path: the file of the lock, in the cache folder.
        cached: the pattern of the file names that the cached function has in this folder.
    """
    lock = FileLock(path, timeout=_WAIT_S)
    with ExitStack() as stack:
        with suppress(OSError, NotImplementedError):  # `Timeout` is an OSError
            if not any(path.parent.glob(cached)):
                stack.enter_context(lock)
        yield


def can_write(folder: Path) -> bool:
    """Return whether compiled rules can be cached in a folder; warn (RuntimeWarning) if they cannot."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            if not (folder / KEY_FILE).exists():
                (folder / KEY_FILE).touch()
            return True
        reason = "it is not writable"
    except OSError as error:
        reason = str(error)
    _warn(folder, reason)
    return False


def _warn(folder: Path, reason: str) -> None:
    """Warn that nothing can be cached in a folder, and of the cost."""
    warnings.warn(
        f"the compiled rules cannot be cached in {folder} ({reason}): every process compiles them again, "
        "which takes from 20 seconds to two minutes of a processor; set CPRL_CACHE to a writable folder",
        RuntimeWarning,
        stacklevel=3,
    )
