"""Compiles the rules: every target is built from the same plain Python functions.

What relies on private parts of Numba is here, each in a function or constant of its own: `CPU_OPTIONS`,
`kept_in`, `kept_on_disk`, `_is_kept` and `machine_code`. `tests/test_compat.py` has a test for each.
"""

import hashlib
import os
import pickle
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from functools import cache, partial
from io import BytesIO
from pathlib import Path
from types import FunctionType
from typing import Any, Final

import numba
from filelock import FileLock

from cprl.commons import loops
from cprl.system.libraries import relying_on
from cprl.system.process import cache_folder, obey_parent
from cprl.system.times import CLOCK

Compiled = dict[str, Callable[..., Any]]

CPU_OPTIONS: Final[Mapping[str, Any]] = {"nogil": True, "error_model": "numpy", "_nrt": False}
"""Of `numba.njit`. `_nrt`, which is private, refuses any allocation inside a function, and spares the
counting of references to the many arrays handed on, which would take fifty times as long as the game."""

_SETTINGS: Final[Any] = numba.config
_CHECKSUM_BYTES: Final = 16
_WAIT_S: Final = 300.0
"""How long a process waits for another one that compiles the same, before it does so itself."""


@contextmanager
def kept_in(folder: Path) -> Iterator[None]:
    """While it is open, functions that are decorated with `cache=True` are kept in that folder.

    Numba documents its setting as an environment variable, read when Numba is imported.
    """
    with relying_on("numba", "numba.config.CACHE_DIR"):
        usual = _SETTINGS.CACHE_DIR
    _SETTINGS.CACHE_DIR = str(folder)
    try:
        yield
    finally:
        _SETTINGS.CACHE_DIR = usual


def kept_on_disk(function: FunctionType, *, in_child: Callable[[], Any] | None = None, **options: Any) -> Any:
    """Compile a function with Numba, and keep it on disk as far as the disk takes it.

    Of processes that lack it at the same time one compiles it, and the others wait and read it. Where it
    cannot be kept or read, e.g. on a full disk, each compiles it. Files have a checksum, which is compared
    before they are read: Numba would run damaged machine code, and stop at any other damage, each time.

    Args:
        in_child: gives the same compiled function in another process. A child then compiles it and this
            process waits, so that it answers Ctrl-C: LLVM works for up to a minute without letting Python
            look at signals.
    """
    try:
        made: Any = numba.njit(**options, cache=True)(function)
    except RuntimeError:  # no folder for it is writable
        return numba.njit(**options)(function)
    if _SETTINGS.DISABLE_JIT:
        return made
    with relying_on("numba", "Dispatcher.compile and its cache"):
        compile_for, stop_caching, folder = made.compile, made._cache.disable, Path(made.stats.cache_path)
        files = made._cache._cache_file
        files._open_for_write = _with_checksum(files._open_for_write)

    def compiled_once(types: Any) -> Any:
        try:
            _remove_damaged(folder, f"*.{function.__name__}-*.nb[ic]")
            if in_child is not None and not _is_child and not _is_kept(made, types):
                _compile_in_child(in_child, types)
            with _alone(folder / f"{function.__name__}.lock", but_if=f"*.{function.__name__}-*.nbi"):
                return compile_for(types)
        except OSError as error:
            _warn(folder, str(error))
            stop_caching()
            return compile_for(types)  # what it gave before it was to be kept, if there is that

    made.compile = compiled_once
    return made


def _with_checksum(open_for_write: Callable[[str], Any]) -> Callable[[str], Any]:
    """Return what opens a file of Numba's cache and writes a checksum behind the rest, where Numba no longer
    reads."""

    @contextmanager
    def opened(path: str) -> Iterator[BytesIO]:
        content = BytesIO()
        yield content
        with open_for_write(path) as file:
            file.write(content.getvalue() + _checksum(content.getvalue()))

    return opened


def _checksum(content: bytes) -> bytes:
    return hashlib.blake2b(content, digest_size=_CHECKSUM_BYTES).digest()


def _remove_damaged(folder: Path, pattern: str) -> None:
    """Remove the files of a function if one is not as it was written, and name each such one in a warning."""
    paths = sorted(folder.glob(pattern))
    damaged = [str(path) for path in paths if not _is_whole(path)]
    if damaged:
        for path in paths:
            path.unlink(missing_ok=True)
        warnings.warn(
            f"{', '.join(damaged)}: damaged, and removed; what it held is compiled again",
            RuntimeWarning,
            stacklevel=3,
        )


def _is_whole(path: Path) -> bool:
    """Return whether a file is as it was written; one that another process has just removed does no harm."""
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return True
    return content[-_CHECKSUM_BYTES:] == _checksum(content[:-_CHECKSUM_BYTES])


def _is_kept(function: Any, types: Any) -> bool:
    """Whether the machine code of a function for arguments of these types is on disk and can be read."""
    with relying_on("numba", "the cache of a Dispatcher"):
        cache, codegen = function._cache, function.targetctx.codegen
        key_of, load = cache._index_key, cache._cache_file.load
    try:
        return load(key_of(types, codegen())) is not None
    except Exception:  # of whatever kind a damaged file gives
        return False


_is_child = False
"""Whether this process compiles for another one."""


def _compile_in_child(function: Callable[[], Any], types: Any) -> None:
    """Let a process of its own compile a function and keep it on disk; if it fails, nothing is kept."""
    start = "from cprl.commons.compiled import compile_for_parent; compile_for_parent()"
    words = [sys.executable, "-c", f"import signal; signal.signal(signal.SIGINT, signal.SIG_IGN); {start}"]
    surroundings = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    quiet = subprocess.DEVNULL
    try:
        child = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=quiet, stderr=quiet, env=surroundings)
    except OSError:  # e.g. where Python is part of another program
        return
    pipe = child.stdin
    assert pipe is not None
    try:
        with suppress(OSError):  # it ended before it read all
            pipe.write(pickle.dumps((function, types)))
            pipe.flush()
        child.wait()
    finally:
        child.kill()
        child.wait()
        with suppress(OSError):
            pipe.close()


def compile_for_parent() -> None:
    """Compile what the process at the other end of standard input asks for, as long as it lives."""
    global _is_child
    _is_child = True
    function, types = pickle.load(sys.stdin.buffer)
    obey_parent()
    function().compile(types)


@contextmanager
def _alone(path: Path, *, but_if: str) -> Iterator[None]:
    """Holds a lock among processes, unless the folder of the lock has a file like `but_if`; without a lock
    where it cannot be had, or not within minutes."""
    lock = FileLock(path, timeout=_WAIT_S)
    with ExitStack() as stack:
        with suppress(OSError, NotImplementedError):  # `Timeout` is an OSError
            if not any(path.parent.glob(but_if)):
                stack.enter_context(lock)
        yield


def machine_code(function: Any, *arguments: Any) -> Callable[..., Any]:
    """The machine code of a compiled function for arguments of the types of these, to be called directly.

    Numba's own call looks at the types of all arguments each time; this one looks at none, so the caller
    must. `Dispatcher.compile` returns it, which Numba does not document.
    """
    if _SETTINGS.DISABLE_JIT:
        raise ValueError(
            "NUMBA_DISABLE_JIT is set, and the rules of the game run as machine code alone; allowed: an "
            "environment without it"
        )
    with relying_on("numba", "Dispatcher.compile"):
        compile_for = function.compile
    code: Callable[..., Any] = compile_for(tuple(map(numba.typeof, arguments)))
    return code


def compiled(
    functions: Iterable[Any], jit: Callable[[FunctionType], Callable[..., Any]], **constants: Any
) -> Compiled:
    """Compile plain functions, and before each of them the functions of `cprl` that it calls.

    Args:
        constants: values of names of their modules, which hold in what is compiled.
    """
    done: dict[FunctionType, Callable[..., Any]] = {}

    def compile_one(function: FunctionType) -> Callable[..., Any]:
        if function not in done:
            names = function.__globals__ | constants
            for name in function.__code__.co_names:
                called = names.get(name)
                if isinstance(called, FunctionType) and called.__module__.startswith("cprl."):
                    names[name] = compile_one(called)
            done[function] = jit(FunctionType(function.__code__, names, function.__name__))
        return done[function]

    return {function.__name__: compile_one(function) for function in functions}


def _jit_for_cpu(function: FunctionType, *, on_disk: bool, further: bool) -> Callable[..., Any]:
    """Compiles a function for CPU threads."""
    options, name = dict(CPU_OPTIONS), function.__name__
    if name not in (entry.__name__ for entry in loops.ENTRIES):
        options |= {"forceinline": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    elif on_disk:
        in_child = partial(_loop_for_cpu, name, further=further) if name in loops.LOOPS else None
        return kept_on_disk(function, in_child=in_child, **options)
    return numba.njit(**options)(function)


def _loop_for_cpu(name: str, *, further: bool) -> Callable[..., Any]:
    return rules_for_cpu(further=further)[name]


@cache
def rules_for_cpu(*, further: bool = False) -> Compiled:
    """The rules compiled for CPU threads, then cached on disk.

    Compiling takes 24 seconds of processor time for the study's game, 80 with institutions and 109 for
    Cleanup, as measured on a busy machine.

    With `further` they hold what `FURTHER_RULES` need, which would slow games without them.

    Numba's own cache checks only the file of the called function and would miss a change in a rule that this
    function calls; so the cache folder is named after the text of all rules.
    """
    folder = cache_folder() / _fingerprint() / ("further" if further else "plain")
    on_disk = _can_write(folder)
    with kept_in(folder):
        return compiled(
            loops.ENTRIES, partial(_jit_for_cpu, on_disk=on_disk, further=further), FURTHER=further
        )


ENTRIES: Final[Mapping[tuple[bool, bool], Compiled]] = {
    (further, governed): {} for further in (False, True) for governed in (False, True)
}
"""The machine code of loops, as far as it was asked for: by whether the game has `FURTHER_RULES`, and whether
it has institutions."""


def compiled_entry(loop: str, arguments: tuple[Any, ...]) -> Callable[..., None]:
    """Put the machine code of a loop into `ENTRIES`, for direct calls with arguments like these.

    Numba's dispatcher inspects the types of about sixty arrays on every call, which takes seven of the eight
    microseconds that one world needs. A direct call inspects nothing, so the caller must check the arguments.
    The types are the same in every game: the fields of `Worlds`, `Tables`, `StepOutput` and `Scratch` have
    fixed types.
    """
    further = arguments[0].tables.further
    entries = ENTRIES[further, arguments[0].law is not None]
    with CLOCK.running():
        entries[loop] = machine_code(rules_for_cpu(further=further)[loop], *arguments)
    return entries[loop]


def _can_write(folder: Path) -> bool:
    """Whether compiled rules can be cached in a folder; warns of the cost if not."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            return True
        reason = "it is not writable"
    except OSError as error:
        reason = str(error)
    _warn(folder, reason)
    return False


def _warn(folder: Path, reason: str) -> None:
    warnings.warn(
        f"the compiled rules cannot be cached in {folder} ({reason}): every process compiles them again, "
        "which takes from 20 seconds to two minutes of a processor; set CPRL_CACHE to a writable folder",
        RuntimeWarning,
        stacklevel=3,
    )


def _fingerprint() -> str:
    """A hash of the source text of all rules."""
    commons = Path(__file__).parent
    sources = sorted(
        path for folder in (commons, commons.parent / "institutions") for path in folder.rglob("*.py")
    )
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:16]
