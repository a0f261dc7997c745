"""Compute a key of all code that a function can reach. Compiled rules are stored on disk under this key."""

import dis
import hashlib
from collections.abc import Iterator
from types import CodeType, FunctionType, ModuleType
from typing import Any, get_args, get_type_hints

import numpy as np

from cprl.values.array_types import is_record


def is_rule(value: Any) -> bool:
    """Return whether a value that a rule names is a function of cprl, which is compiled with the rule."""
    return isinstance(value, FunctionType) and value.__module__.startswith("cprl.")


def code_key(entry: Any, **options: Any) -> str:
    """Return a hash of all code that a function can reach, and of the options of its compiler.

    This is the code of the function and of all functions of `cprl` that it calls, with the constants that
    they name and the fields of their named tuples. Docstrings, comments, annotations, line numbers, and code
    that no rule calls do not change the hash.

    Args:
        entry: the function.
        options: the options of the compiler, by name.
    """
    texts: dict[Any, str] = {"options": repr(sorted(options.items()))}
    _add_function(entry, texts)
    return hashlib.sha256(repr(sorted(texts.values())).encode()).hexdigest()[:16]


def _add_function(function: FunctionType, texts: dict[Any, str]) -> None:
    """Add the text of a function and of all that it reaches to `texts`, by function or class.

    The text of a function has its instructions, and the values of the global names in it.
    """
    if function in texts:
        return
    codes = list(_nested_codes(function.__code__))
    names = sorted({name for code in codes for name in code.co_names})
    texts[function] = f"{_dotted_name(function)} {[_instructions(code) for code in codes]}"
    for name in names:
        value: Any = function.__globals__.get(name)
        texts[function] += f", {name}: {_value_text(value)}"
        if isinstance(value, ModuleType) and value.__name__.startswith("cprl."):
            texts[function] += f" {[_value_text(getattr(value, attribute, None)) for attribute in names]}"
        if is_rule(value):
            _add_function(value, texts)
        elif is_record(value):
            _add_tuple_class(value, texts)


def _add_tuple_class(kind: Any, texts: dict[Any, str]) -> None:
    """Add the fields of a class of named tuples, and of the classes in its annotations, to `texts`."""
    if kind in texts:
        return
    texts[kind] = f"{_dotted_name(kind)} {kind._fields}"
    for hint in get_type_hints(kind).values():
        for inner_kind in filter(is_record, (hint, *get_args(hint))):
            _add_tuple_class(inner_kind, texts)


def _dotted_name(value: Any) -> str:
    """Return the name of a function or class with its module."""
    return f"{value.__module__}.{value.__qualname__}"


def _value_text(value: Any) -> str:
    """Return the value of a global name as text.

    The text is "" for modules and builtins, since they follow from the installed versions.
    """
    if is_rule(value) or is_record(value):
        return _dotted_name(value)
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {value.shape} {value.tobytes().hex()}"
    return repr(value) if isinstance(value, int | float | str | tuple | np.generic) else ""


def _nested_codes(code: CodeType) -> Iterator[CodeType]:
    """Yield a code object, and the code objects of the functions that are defined in it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _nested_codes(constant)


def _instructions(code: CodeType) -> str:
    """Return the instructions of a code object as text, with the names and constants that they use."""
    instructions = dis.get_instructions(code)
    return str([(instruction.opname, _argument(instruction.argval)) for instruction in instructions])


def _argument(value: Any) -> str:
    """Return the argument of an instruction as text; "" for code objects, which are added themselves."""
    return "" if isinstance(value, CodeType) else repr(value)
