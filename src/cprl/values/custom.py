"""Custom: user code as text that a run's recipe can keep, and which of it may be imported.

A recipe that somebody else made names code that loading it would import. Such a recipe is refused unless this
process trusts each name: `--allow module:Class` on the command line, `cprl.trust` in Python.

A class or function that no module has, because it was defined in a script, a notebook or a function, is
handed over live: the recipe holds its name, and only the process that has the object can use it.
"""

import importlib
import json
import re
import reprlib
import secrets
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from importlib.util import find_spec
from types import FunctionType
from typing import Any, Final

_NAME_PATTERN: Final = re.compile(r"[\w-]+(\.[\w-]+)*:\w+(\.\w+)*", re.ASCII)
_LIVE_KEY_PATTERN: Final = re.compile(r"([0-9a-f]{8}-\d+)?", re.ASCII)
_LIVE_NAME_PATTERN: Final = re.compile(r"[\w.-]+:[\w.<>]+")
"""The names of live objects; those of nested functions contain "<locals>"."""
_LONGEST_NAME: Final = 1000
MOST_NESTED: Final = 64

_LIVE: Final[dict[str, Any]] = {}
"""The live classes and functions of this process, by keys that no other process has."""


@dataclass(frozen=True)
class Custom:
    """A class or function of the user, named by its module, with arguments that JSON can hold.

    An `Experiment` holds values only, so that its recipe describes it completely; a transform, callback,
    logger, network, algorithm or game of your own is handed over as a `Custom`. Nothing is imported before
    `make` is called, and a stored run may import only what you trust (`cprl.trust`).

    Args:
        target: "module:Class" or "module:function".
        arguments: its keyword arguments; strings, numbers, booleans, None, values of cprl, and lists and
            tables of them. A list of strings within a list becomes a tuple, so that nested TensorDict keys
            can be said: `{"in_keys": [["agents", "reward"]]}`.
        live: the key of an object of this process that no module has; "" for one that `target` imports. See
            `custom_of`.
    """

    target: str
    arguments: Mapping[str, Any] = field(default_factory=dict)
    live: str = ""

    def __post_init__(self) -> None:
        if not isinstance(self.live, str) or not _LIVE_KEY_PATTERN.fullmatch(self.live):
            raise ValueError(f'Custom.live is {short_repr(self.live)}; allowed: "", or what `custom_of` says')
        is_text = isinstance(self.target, str) and len(self.target) <= _LONGEST_NAME
        names = _LIVE_NAME_PATTERN if self.live else _NAME_PATTERN
        if not is_text or not names.fullmatch(self.target):
            raise ValueError(f'Custom.target is {short_repr(self.target)}; allowed: "module:Class"')
        if not isinstance(self.arguments, Mapping):
            given = short_repr(self.arguments)
            raise ValueError(f"Custom.arguments is {given}; allowed: a table of keyword arguments")
        try:
            refuse_other_keys(self.arguments)
            text = json.dumps(dict(self.arguments), allow_nan=False, default=_to_json)
            object.__setattr__(self, "arguments", json.loads(text))
        except (TypeError, ValueError, RecursionError) as error:
            raise ValueError(
                f"Custom.arguments of {self.target!r} cannot be kept as JSON: {error}"
            ) from error

    def __hash__(self) -> int:
        return hash((self.target, json.dumps(self.arguments, sort_keys=True), self.live))

    def resolve(self) -> Any:
        """Import the target and return it.

        Raises:
            ValueError: if it cannot be imported, or is a live object of another process.
        """
        if self.live:
            refuse_live([{"kind": "Custom", "target": self.target, "live": self.live}], only_foreign=True)
            return _LIVE[self.live]
        module, _, name = self.target.partition(":")
        try:
            target: Any = importlib.import_module(module)
            for part in name.split("."):
                target = getattr(target, part)
        except (ImportError, AttributeError) as error:
            cure = "; allowed: a module in the folder where the command is given, or in one of PYTHONPATH"
            cure = cure if isinstance(error, ModuleNotFoundError) else ""
            raise ValueError(f"Custom({self.target!r}) cannot be imported: {error}{cure}") from error
        source_of(module)
        return target

    def make(self, *positional: Any) -> Any:
        """Call the target with its arguments and return the result.

        Raises:
            ValueError: if it cannot be imported, or does not take its arguments.
        """
        target = self.resolve()
        try:
            return target(
                *positional, **{name: _to_argument(value) for name, value in self.arguments.items()}
            )
        except TypeError as error:
            raise ValueError(f"Custom({self.target!r}) does not take its arguments: {error}") from error


def custom_of(value: Any) -> Any:
    """Return a class, a function, or a `functools.partial` of one with keyword arguments, as a `Custom`: by
    its name if a module has it, else live. An object that is defined again is a different one. Return
    anything else unchanged."""
    target = value.func if isinstance(value, partial) and not value.args else value
    if not isinstance(target, type | FunctionType) or target.__module__ == "builtins":
        return value
    name = f"{target.__module__}:{target.__qualname__}"
    arguments = value.keywords if isinstance(value, partial) else {}
    if target.__module__ != "__main__" and _find_imported(name) is target:
        return Custom(name, arguments)
    lives = (live for live, known in _LIVE.items() if known is target)
    live = next(
        lives, f"{secrets.token_hex(4)}-{len(_LIVE)}"
    )  # random, so that a forked process has other keys
    _LIVE[live] = target
    return Custom(name, arguments, live)


def _find_imported(name: str) -> Any:
    """Return the object "module:name" of the modules imported so far; None if there is none."""
    module, _, path = name.partition(":")
    target: Any = sys.modules.get(module)
    for part in path.split("."):
        target = getattr(target, part, None)
    return target


_TRUSTED: Final[set[str]] = set()
"""The targets that this process may import for stored tables."""


def trust(*targets: str) -> None:
    """Trust user code, each named "module:Class", for the rest of this process.

    Recipes, runs and studies that name it can then be read, and may import it.
    """
    _TRUSTED.update(targets)


@contextmanager
def trusting(targets: Iterable[str]) -> Iterator[None]:
    """Trust user code, each named "module:Class", within a block only, for tests."""
    before = set(_TRUSTED)
    _TRUSTED.update(targets)
    try:
        yield
    finally:
        _TRUSTED.intersection_update(before)


def trusted() -> tuple[str, ...]:
    """Return the targets that this process trusts, for processes that it starts."""
    return tuple(sorted(_TRUSTED))


METRIC_WORDS: Final[dict[str, Mapping[str, str]]] = {}
"""The "title" and "unit" of custom metrics by name, from the recipe that this process read last."""


def metric_words(metric: Custom) -> dict[str, str]:
    """Return the attributes "title" and "unit" of a custom metric, if its function has them.

    Raises:
        ValueError: if one is no text.
    """
    function = metric.resolve()
    words = {name: getattr(function, name) for name in ("title", "unit") if hasattr(function, name)}
    for name, word in words.items():
        if not isinstance(word, str):
            raise ValueError(f"{metric.target}.{name} is {short_repr(word)}; allowed: a text")
    return words


def custom_targets(table: object) -> list[str]:
    """Return the sorted targets of all `Custom` in a table that are imported by name."""
    return sorted({str(entry.get("target")) for entry in _custom_tables(table) if not entry.get("live")})


def live_targets(table: object) -> list[str]:
    """Return the sorted names of all live `Custom` in a table."""
    entries = _custom_tables(table)
    return sorted({_printable(str(entry.get("target"))) for entry in entries if entry.get("live")})


def _printable(text: str) -> str:
    """Return an untrusted text with unprintable characters replaced."""
    return "".join(sign if sign.isprintable() else "?" for sign in text)


def refuse_live(table: object, *, only_foreign: bool = False, where: str = "the experiment") -> None:
    """Raise a ValueError that names the live classes and functions in a table.

    Args:
        only_foreign: whether live objects of this process are allowed.
        where: the name of the table in messages.
    """
    entries = [entry for entry in _custom_tables(table) if entry.get("live")]
    refused = [entry for entry in entries if not (only_foreign and str(entry["live"]) in _LIVE)]
    if refused:
        raise ValueError(
            f"{where} has {', '.join(live_targets(refused))}, which only the process that it was handed to "
            "live can use; allowed: a class or function at the top of a module, which has a name"
        )


def describe_customs(table: object) -> list[str]:
    """Return a description of each piece of user code in a table: "laws:RichPay (fee 2.0): The rich pay".

    The sentence is the first line of its docstring. Nothing is imported for it: code whose module is not
    imported yet is described by its name and arguments alone.
    """
    entries = _custom_tables(table)
    customs = [
        Custom(entry["target"], entry.get("arguments", {}), entry.get("live", "")) for entry in entries
    ]
    return list(dict.fromkeys(map(_describe, customs)))


def _describe(custom: Custom) -> str:
    arguments = ", ".join(f"{name} {short_repr(value)}" for name, value in custom.arguments.items())
    words = f"{custom.target} ({arguments})" if arguments else custom.target
    target = _LIVE.get(custom.live) if custom.live else _find_imported(custom.target)
    lines = str(getattr(target, "__doc__", None) or "").strip().splitlines()
    words = f"{words}: {lines[0].rstrip('.')}" if lines else words
    return _printable(words)


def refuse_targets(table: object) -> None:
    """Raise a ValueError for a table with untrusted user code, or with live objects of another process."""
    refuse_live(table, only_foreign=True)
    refused = [target for target in custom_targets(table) if target not in _TRUSTED]
    if refused:
        refused = list(map(_printable, refused))
        flags = " ".join(f"--allow {target}" for target in refused)
        names = ", ".join(map(repr, refused))
        raise ValueError(
            f"{', '.join(refused)} would be imported, which is code of somebody's own; if you trust it: "
            f"{flags} (in Python cprl.trust({names}))"
        )


def _custom_tables(table: object) -> Iterator[Mapping[str, Any]]:
    if isinstance(table, Mapping):
        entries: Any = table
        if table.get("kind") == "Custom":
            yield table
            entries = table.get("arguments")
        for entry in entries.values() if isinstance(entries, Mapping) else ():
            yield from _custom_tables(entry)
    elif isinstance(table, list | tuple):
        for entry in table:
            yield from _custom_tables(entry)


_SOURCES: Final[dict[str, tuple[object, str | None]]] = {}
"""The source of each imported module, with its `__spec__`, which changes at a reload."""


def source_of(module: str) -> str | None:
    """Return the source of a module without importing it; None if it has no file, e.g. in a notebook.

    For an imported module this is the source that runs, even if its file was edited since.
    """
    imported = sys.modules.get(module)
    try:
        spec = find_spec(module) if imported is None else imported.__spec__
        loader: Any = spec.loader if spec is not None else getattr(imported, "__loader__", None)
        if imported is not None and module in _SOURCES and _SOURCES[module][0] is spec:
            return _SOURCES[module][1]
        text: str | None = loader.get_source(module)
    except (ImportError, AttributeError, ValueError):
        return None
    if imported is not None:
        _SOURCES[module] = spec, text
    return text


class _Repr(reprlib.Repr):
    """A short representation, in which objects appear as their class instead of by their own `__repr__`."""

    def repr_instance(self, x: Any, level: int) -> str:
        if isinstance(x, type):
            return f"the class {x.__name__}"
        plain_kinds = type(None), bool, float, complex, bytes, range
        return super().repr_instance(x, level) if type(x) in plain_kinds else f"a {type(x).__name__}"


_REPR: Final = _Repr()
_REPR.maxlevel = 4
_REPR.maxtuple = _REPR.maxlist = 20
_REPR.maxstring = _REPR.maxother = 120


def short_repr(value: object) -> str:
    """Return a value as short text for a message, on one line; an object as its class."""
    try:
        return " ".join(_REPR.repr(value).split())
    except Exception:  # a `__repr__` may raise anything, and an integer may be too long to print
        return f"a {type(value).__name__} that cannot be shown"


def instantiate(value: Any, *positional: Any) -> Any:
    """Return what a `Custom` makes; return anything else unchanged."""
    return value.make(*positional) if isinstance(value, Custom) else value


def refuse_other_keys(value: Any, *, most: int = MOST_NESTED, depth: int = 0) -> None:
    """Refuse a value with keys that are no text, which JSON would turn into text, and one that is nested too
    deep for recursive functions."""
    if depth > most:
        raise ValueError(f"it is nested more than {most} deep")
    if isinstance(value, str | float | int):
        return
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, str):
                raise TypeError(f"a table has the key {key!r}; allowed: text")
        value = value.values()
    elif not isinstance(value, list | tuple):
        return
    for entry in value:
        refuse_other_keys(entry, most=most, depth=depth + 1)


def _to_json(value: object) -> Any:
    """Return a value of cprl as JSON can hold it; `json.dumps` calls it for everything else than JSON."""
    from cprl.values import to_config

    return to_config(value, f"a {type(value).__name__}")


def _to_argument(value: Any) -> Any:
    """Return an argument as the target gets it."""
    if isinstance(value, Mapping):
        from cprl.values import from_config, is_value

        return from_config(value) if is_value(value) else value
    return list(map(_to_list_entry, value)) if isinstance(value, list) else value


def _to_list_entry(value: Any) -> Any:
    """Return an entry of a list as the target gets it: a list of texts, such as a nested key, as a tuple."""
    is_key = isinstance(value, list) and all(isinstance(part, str) for part in value)
    return tuple(value) if is_key else _to_argument(value)
