"""Compile the rules with Numba, for the CPU or the GPU, from the same plain Python functions.

`CPU_OPTIONS` and `machine_code` use private parts of Numba, as do the modules `disk_cache`, `records` and
`linking`. `tests/system/test_compat.py` has a test for each of these parts.
"""

import os
from collections.abc import Callable, Iterable, Mapping
from functools import cache, partial
from threading import Lock
from types import FunctionType
from typing import Any, Final

import numba

from cprl.system.jit.code_key import code_key, is_rule
from cprl.system.jit.disk_cache import KEY_FILE, can_write, compile_with_disk_cache, numba_cache_in
from cprl.system.jit.linking import AS_PART, AS_WHOLE
from cprl.system.jit.records import VERSION, by_reference, type_of, with_local
from cprl.system.libraries import relying_on
from cprl.system.process import cache_folder
from cprl.system.times import CLOCK
from cprl.values import refusal

RULES_VARIABLE: Final = "CPRL_RULES"
"""The environment variable that says how rules run: "compiled" (the default) or "python"."""
COMPILED_RULES: Final = "compiled"
PLAIN_RULES: Final = "python"
_SETTINGS: Final[Any] = numba.config

CPU_OPTIONS: Final[Mapping[str, Any]] = {"nogil": True, "error_model": "numpy", "_nrt": False}
"""The options of `numba.njit` for the CPU. The private option `_nrt` forbids allocations inside a function.
References to the many arrays in arguments then need not be counted, which would take fifty times as long as
the game."""


def runs_plain() -> bool:
    """Return whether rules run as plain Python functions, without being compiled.

    They do with CPRL_RULES=python or NUMBA_DISABLE_JIT=1 in the environment. Print, breakpoints and coverage
    then work in the rules, which are some hundred times slower.
    """
    mode = os.environ.get(RULES_VARIABLE, COMPILED_RULES)
    if mode not in (COMPILED_RULES, PLAIN_RULES):
        raise refusal(RULES_VARIABLE, mode, f'"{COMPILED_RULES}" and "{PLAIN_RULES}"')
    return mode == PLAIN_RULES or bool(_SETTINGS.DISABLE_JIT)


def machine_code(entry: Callable[..., Any], *arguments: Any) -> Callable[..., Any]:
    """Compile an entry, and return a function that calls its machine code directly.

    Numba's usual call inspects the types of all arguments each time. The returned function inspects none, so
    the caller must make sure that they are those of `arguments`. Numba does not document that
    `Dispatcher.compile` returns such a function.

    Args:
        entry: a function that drivers call, one of `cprl.commons.loops.ENTRIES`.
        arguments: arguments of the types for which it is compiled. The first one is a named tuple; later
            calls may pass a plain tuple in its place.
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
    functions: Iterable[Any], jit: Callable[[FunctionType], Callable[..., Any]], **replacements: Any
) -> dict[str, Callable[..., Any]]:
    """Compile plain functions, and before each of them the functions of `cprl` that it calls.

    Args:
        functions: the functions to compile.
        jit: compiles one function, whose called functions are compiled already.
        replacements: functions to call in place of those with the same names.

    Returns:
        The compiled functions by name.
    """
    compiled_functions: dict[FunctionType, Callable[..., Any]] = {}

    def compile_one(function: FunctionType) -> Callable[..., Any]:
        """Return a function compiled, from a copy whose global names are compiled functions."""
        if function not in compiled_functions:
            names = function.__globals__ | replacements
            for name in function.__code__.co_names:
                called: Any = names.get(name)
                if is_rule(called):
                    names[name] = compile_one(called)
            copy = FunctionType(function.__code__, names, function.__name__)
            copy.__dict__.update(function.__dict__)
            compiled_functions[function] = jit(copy)
        return compiled_functions[function]

    return {function.__name__: compile_one(function) for function in functions}


def compiled_for_cpu(entry: Callable[..., Any], *, inline: bool = True) -> Any:
    """Return a function compiled for CPU threads, together with all rules that it calls.

    The machine code is cached on disk in a folder named after the `code_key` of the function. So a change to
    other code compiles nothing, and several copies of this program share the cache. The function itself is
    returned where rules run as plain Python.

    Args:
        entry: the function to compile.
        inline: whether it and all rules become one piece of machine code. This runs faster, but it takes so
            long to compile that a child process does it.
    """
    return entry if runs_plain() else _compiled_for_cpu(entry, inline)


_ONE_AT_A_TIME: Final = Lock()
"""Held while rules are compiled, since `numba_cache_in` changes a setting of the whole process."""


@cache
def _compiled_for_cpu(entry: Any, inline: bool) -> Any:
    """Return a compiled function, see `compiled_for_cpu`; a child process calls this too."""
    options = dict(CPU_OPTIONS)
    rule_options = options | {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    if inline:
        rule_options["forceinline"] = True
        options["no_cfunc_wrapper"] = True
        rule_options |= AS_PART
        options |= AS_WHOLE
    key = code_key(entry, records=VERSION, inline=inline, **CPU_OPTIONS)
    folder = cache_folder() / "rules" / f"{entry.__name__}-{key}"

    def jit(function: FunctionType) -> Any:
        sliced = getattr(function, "sliced", None)
        if sliced is not None:
            return by_reference(sliced)
        if function.__code__ is entry.__code__ and not inline:
            return compile_entry(function)
        return numba.njit(**rule_options)(function)

    def compile_entry(function: FunctionType) -> Any:
        if not can_write(folder):
            return numba.njit(**options)(function)
        # Numba uses cached code as long as path and date of the function's source file stay the same. They do
        # not change with the rules that it calls, so its code claims to come from a file in the folder of its
        # key.
        function.__code__ = function.__code__.replace(co_filename=str(folder / KEY_FILE), co_firstlineno=1)
        in_child = partial(_compiled_for_cpu, entry, inline) if inline else None
        return compile_with_disk_cache(function, in_child=in_child, **options)

    with _ONE_AT_A_TIME, numba_cache_in(folder):
        compiled_entry = compiled([entry], jit)[entry.__name__]
        return compile_entry(with_local(entry, compiled_entry)) if inline else compiled_entry
