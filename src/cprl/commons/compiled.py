"""Compiles the rules: every target is built from the same plain Python functions.

What relies on private parts of Numba is here, each in a function or constant of its own: `CPU_OPTIONS`,
`kept_in`, `kept_on_disk`, `_is_kept` and `machine_code`; and in `cprl.commons.records` and `linking`.
`tests/test_compat.py` has a test for each.
"""

import dis
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
from threading import Lock
from types import CodeType, FunctionType, ModuleType
from typing import Any, Final, get_args, get_type_hints

import numba
import numpy as np
from filelock import FileLock

from cprl.commons.linking import AS_PART, AS_WHOLE
from cprl.commons.records import VERSION, by_reference, type_of, with_local
from cprl.institutions.arrays import is_record
from cprl.system.libraries import relying_on
from cprl.system.process import cache_folder, obey_parent
from cprl.system.times import CLOCK
from cprl.values import refusal

RULES_VARIABLE: Final = "CPRL_RULES"
"""The environment variable that says how rules run."""
COMPILED, PLAIN = "compiled", "python"

KEY_FILE: Final = "key.py"
"""Stands for the file of what is kept in a folder."""

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
    """Return whether the machine code of a function for arguments of these types is on disk and can be
    read."""
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
    """Hold a lock among processes, unless the folder of the lock has a file like `but_if`; without a lock
    where it cannot be had, or not within minutes."""
    lock = FileLock(path, timeout=_WAIT_S)
    with ExitStack() as stack:
        with suppress(OSError, NotImplementedError):  # `Timeout` is an OSError
            if not any(path.parent.glob(but_if)):
                stack.enter_context(lock)
        yield


def runs_plain() -> bool:
    """Return whether rules run as the plain Python functions that they are: with CPRL_RULES=python in the
    environment, or NUMBA_DISABLE_JIT=1. Print, breakpoints and coverage then work in them; they are some
    hundred times slower."""
    word = os.environ.get(RULES_VARIABLE, COMPILED)
    if word not in (COMPILED, PLAIN):
        raise refusal(RULES_VARIABLE, word, f'"{COMPILED}" and "{PLAIN}"')
    return word == PLAIN or bool(_SETTINGS.DISABLE_JIT)


def machine_code(entry: Callable[..., Any], *arguments: Any) -> Callable[..., Any]:
    """Return the machine code of an entry for arguments of the types of these, to be called directly.

    The first argument is a tuple, and may be a plain one in later calls. Numba's own call looks at the types
    of all arguments each time; this one looks at none, so the caller must. `Dispatcher.compile` returns it,
    which Numba does not document.
    """
    if runs_plain():
        make = getattr(type(arguments[0]), "_make", tuple)
        return lambda first, *others: entry(make(first), *others)
    with relying_on("numba", "Dispatcher.compile"):
        compile_for = compiled_for_cpu(entry).compile
    with CLOCK.running():
        code: Callable[..., Any] = compile_for(tuple(map(type_of, arguments)))
    return code


def compiled(
    functions: Iterable[Any], jit: Callable[[FunctionType], Callable[..., Any]], **others: Any
) -> Compiled:
    """Compile plain functions, and before each of them the functions of `cprl` that it calls.

    Args:
        others: functions to take in place of those of these names.
    """
    done: dict[FunctionType, Callable[..., Any]] = {}

    def compile_one(function: FunctionType) -> Callable[..., Any]:
        if function not in done:
            names = function.__globals__ | others
            for name in function.__code__.co_names:
                called: Any = names.get(name)
                if _is_rule(called):
                    names[name] = compile_one(called)
            copy = FunctionType(function.__code__, names, function.__name__)
            copy.__dict__.update(function.__dict__)
            done[function] = jit(copy)
        return done[function]

    return {function.__name__: compile_one(function) for function in functions}


def _is_rule(value: Any) -> bool:
    """Return whether a name in a rule stands for a function that is compiled with it."""
    return isinstance(value, FunctionType) and value.__module__.startswith("cprl.")


def compiled_for_cpu(entry: Callable[..., Any], *, inline: bool = True) -> Any:
    """Return a function compiled for CPU threads, with all rules that it calls, and kept on disk; the
    function itself where rules run as plain Python.

    Its folder is named after the code that it can reach, see `code_key`: what changes no rule compiles
    nothing, also in another copy of this program.

    Args:
        inline: whether the rules become one piece of code, which runs faster and takes so long to compile
            that a process of its own does it.
    """
    return entry if runs_plain() else _compiled_for_cpu(entry, inline)


_ONE_AT_A_TIME: Final = Lock()
"""`kept_in` changes a setting of the whole process."""


@cache
def _compiled_for_cpu(entry: Any, inline: bool) -> Any:
    options = dict(CPU_OPTIONS)
    inner = options | {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    if inline:
        inner["forceinline"] = True
        options["no_cfunc_wrapper"] = True
        inner |= AS_PART
        options |= AS_WHOLE
    key = code_key(entry, records=VERSION, inline=inline, **CPU_OPTIONS)
    folder = cache_folder() / "rules" / f"{entry.__name__}-{key}"

    def jit(function: FunctionType) -> Any:
        sliced = getattr(function, "sliced", None)
        if sliced is not None:
            return by_reference(sliced)
        if function.__code__ is entry.__code__ and not inline:
            return kept(function)
        return numba.njit(**inner)(function)

    def kept(function: FunctionType) -> Any:
        if not _can_write(folder):
            return numba.njit(**options)(function)
        # Numba asks when the file of a function was changed, and where it is, which says nothing of the rules
        # that it calls: so it stands in a file of its folder.
        function.__code__ = function.__code__.replace(co_filename=str(folder / KEY_FILE), co_firstlineno=1)
        in_child = partial(_compiled_for_cpu, entry, inline) if inline else None
        return kept_on_disk(function, in_child=in_child, **options)

    with _ONE_AT_A_TIME, kept_in(folder):
        made = compiled([entry], jit)[entry.__name__]
        return kept(with_local(entry, made)) if inline else made


def code_key(entry: Any, **options: Any) -> str:
    """Return a hash of the code that a function can reach: its own, that of the functions of `cprl` that it
    calls, the constants that they name, and the fields of their tuples; and of options of the compiler.

    Docstrings, comments, annotations, the places of lines, and whatever no rule calls do not count.
    """
    parts: dict[Any, str] = {"options": repr(sorted(options.items()))}
    _note_function(entry, parts)
    return hashlib.sha256(repr(sorted(parts.values())).encode()).hexdigest()[:16]


def _note_function(function: FunctionType, parts: dict[Any, str]) -> None:
    """Note the code of a function with what the names in it stand for, and the functions that it calls."""
    if function in parts:
        return
    codes = list(_codes(function.__code__))
    names = sorted({name for code in codes for name in code.co_names})
    parts[function] = f"{_place(function)} {[_text_of(code) for code in codes]}"
    for name in names:
        value: Any = function.__globals__.get(name)
        parts[function] += f", {name}: {_meaning(value)}"
        if isinstance(value, ModuleType) and value.__name__.startswith("cprl."):
            parts[function] += f" {[_meaning(getattr(value, inner, None)) for inner in names]}"
        if _is_rule(value):
            _note_function(value, parts)
        elif is_record(value):
            _note_tuple(value, parts)


def _note_tuple(kind: Any, parts: dict[Any, str]) -> None:
    """Note the fields of a named tuple, and of the tuples in it."""
    if kind in parts:
        return
    parts[kind] = f"{_place(kind)} {kind._fields}"
    for hint in get_type_hints(kind).values():
        for inner in filter(is_record, (hint, *get_args(hint))):
            _note_tuple(inner, parts)


def _place(value: Any) -> str:
    return f"{value.__module__}.{value.__qualname__}"


def _meaning(value: Any) -> str:
    """Return what a name in a rule stands for; modules and builtins are those of the versions installed."""
    if _is_rule(value) or is_record(value):
        return _place(value)
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {value.shape} {value.tobytes().hex()}"
    return repr(value) if isinstance(value, int | float | str | tuple | np.generic) else ""


def _codes(code: CodeType) -> Iterator[CodeType]:
    """Yield a code object and those in it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes(constant)


def _text_of(code: CodeType) -> str:
    """Return the instructions of a code object with the names and constants that they use."""
    return str([(step.opname, _argument(step.argval)) for step in dis.get_instructions(code)])


def _argument(value: Any) -> str:
    return "" if isinstance(value, CodeType) else repr(value)


def _can_write(folder: Path) -> bool:
    """Return whether compiled rules can be cached in a folder; warns of the cost if not."""
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
    warnings.warn(
        f"the compiled rules cannot be cached in {folder} ({reason}): every process compiles them again, "
        "which takes from 20 seconds to two minutes of a processor; set CPRL_CACHE to a writable folder",
        RuntimeWarning,
        stacklevel=3,
    )
