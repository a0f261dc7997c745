"""The rules, compiled: one source, each function rebuilt for the target that is to run it."""

import hashlib
import os
import warnings
from collections.abc import Callable, Iterable
from functools import cache, partial
from pathlib import Path
from types import FunctionType
from typing import Any

import numba
from numba.core import config

from cprl.commons.loops import FUNCTIONS, LOOPS

numba_settings: Any = config
Compiled = dict[str, Callable[..., Any]]


def compiled(functions: Iterable[Any], jit: Callable[[FunctionType], Callable[..., Any]]) -> Compiled:
    """Each plain function rebuilt so that it calls the compiled ones before it, by name.

    One source of the rules for every target: `jit` says which.
    """
    ready: Compiled = {}
    for function in functions:
        known = {**function.__globals__, **ready}
        ready[function.__name__] = jit(FunctionType(function.__code__, known, function.__name__))
    return ready


def _jit_for_cpu(function: FunctionType, *, keep: bool) -> Callable[..., Any]:
    """Numba for a CPU thread. `_nrt=False` refuses any allocation inside a rule, and spares the counting
    of references to the many arrays handed on, which would take fifty times as long as the game."""
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "_nrt": False}
    if function.__name__ in (*LOOPS, "first_unknown"):
        options |= {"cache": keep}
    else:
        options |= {"forceinline": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return numba.njit(**options)(function)


@cache
def rules_for_cpu() -> Compiled:
    """The rules compiled for CPU threads: ten seconds the first time, then kept on disk.

    Numba's own cache looks only at the file of the function called, and would miss a change in a rule that
    it calls; so the folder is named after the text of all rules.
    """
    folder = _cache_folder() / _fingerprint()
    keep = _can_write(folder)
    usual = numba_settings.CACHE_DIR
    numba_settings.CACHE_DIR = str(folder)
    try:
        return compiled(FUNCTIONS, partial(_jit_for_cpu, keep=keep))
    finally:
        numba_settings.CACHE_DIR = usual


_entries: dict[str, Callable[..., None]] = {}


def entry_for_cpu(loop: str, *arguments: Any) -> Callable[..., None]:
    """The machine code of a loop, to be called directly with arguments of the same types as these.

    Numba's own call looks at the types of some sixty arrays each time, which takes seven of eight
    microseconds for one world; this one looks at none, so the caller must. The types are those of every
    game: `Worlds`, `Tables`, `StepOutput` and `Scratch` never change theirs.
    """
    if loop not in _entries:
        types = tuple(map(numba.typeof, arguments))
        _entries[loop] = rules_for_cpu()[loop].compile(types)  # type: ignore[attr-defined]
    return _entries[loop]


def _can_write(folder: Path) -> bool:
    """Whether compiled rules can be kept there; if not, a warning says what that costs."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            return True
        reason = "it is not writable"
    except OSError as error:
        reason = str(error)
    warnings.warn(
        f"the compiled rules cannot be kept in {folder} ({reason}): every process compiles them anew, about "
        "ten seconds; set CPRL_CACHE to a folder that can be written",
        RuntimeWarning,
        stacklevel=2,
    )
    return False


def _cache_folder() -> Path:
    """$CPRL_CACHE, or cprl in the user's cache folder."""
    if "CPRL_CACHE" in os.environ:
        return Path(os.environ["CPRL_CACHE"])
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "cprl"


def _fingerprint() -> str:
    """A name for this text of the rules."""
    sources = sorted(path for path in Path(__file__).parent.rglob("*.py"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:16]
