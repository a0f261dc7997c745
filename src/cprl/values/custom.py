"""Custom: something of the user's own, as a text that a run's recipe can keep; and what is allowed of it.

A recipe that somebody else made names code that loading it would import. Such a recipe is refused unless this
process trusts each name: `--allow module:Class` on the command line, `cprl.trust` in Python.

What no module has, because it was defined in a script, a notebook or a function, is handed over live: the
recipe says what it was called, and only the process that has it can use it.
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

_NAMES: Final = re.compile(r"[\w-]+(\.[\w-]+)*:\w+(\.\w+)*", re.ASCII)
_LIVES: Final = re.compile(r"([0-9a-f]{8}-\d+)?", re.ASCII)
_LIVE_NAMES: Final = re.compile(r"[\w.-]+:[\w.<>]+")
"""Those of functions within functions have "<locals>"."""
_LONGEST_NAME: Final = 1000
MOST_NESTED: Final = 64

_LIVE: Final[dict[str, Any]] = {}
"""The classes and functions that this process was handed live, by texts that no other process has."""


@dataclass(frozen=True)
class Custom:
    """A class or function of the user's own, by its name, with arguments that JSON can hold.

    An `Experiment` holds values only, so that its recipe says all of it: a transform, callback, logger,
    network, algorithm or game that is not one of cprl's is handed over like this. Nothing is imported before
    `make` is called; who loads a stored run says what it may import (`cprl.trust`).

    Args:
        target: "module:Class" or "module:function".
        arguments: its keyword arguments; strings, numbers, booleans, None, values of cprl, and lists and
            tables of them. A list of strings within a list becomes a tuple, so that nested TensorDict keys
            can be said: `{"in_keys": [["agents", "reward"]]}`.
        live: which object of this process it is; "" for one that its name finds. See `custom_of`.
    """

    target: str
    arguments: Mapping[str, Any] = field(default_factory=dict)
    live: str = ""

    def __post_init__(self) -> None:
        if not isinstance(self.live, str) or not _LIVES.fullmatch(self.live):
            raise ValueError(f'Custom.live is {shown(self.live)}; allowed: "", or what `custom_of` says')
        is_text = isinstance(self.target, str) and len(self.target) <= _LONGEST_NAME
        names = _LIVE_NAMES if self.live else _NAMES
        if not is_text or not names.fullmatch(self.target):
            raise ValueError(f'Custom.target is {shown(self.target)}; allowed: "module:Class"')
        if not isinstance(self.arguments, Mapping):
            came = shown(self.arguments)
            raise ValueError(f"Custom.arguments is {came}; allowed: a table of keyword arguments")
        try:
            refuse_other_keys(self.arguments)
            text = json.dumps(dict(self.arguments), allow_nan=False, default=_table_of)
            object.__setattr__(self, "arguments", json.loads(text))
        except (TypeError, ValueError, RecursionError) as error:
            raise ValueError(
                f"Custom.arguments of {self.target!r} cannot be kept as JSON: {error}"
            ) from error

    def __hash__(self) -> int:
        return hash((self.target, json.dumps(self.arguments, sort_keys=True), self.live))

    def resolve(self) -> Any:
        """Import the target and return it."""
        if self.live:
            refuse_live([{"kind": "Custom", "target": self.target, "live": self.live}], of_others=True)
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
        """Call the target with its arguments and return what it makes."""
        target = self.resolve()
        try:
            return target(*positional, **{name: _argument(value) for name, value in self.arguments.items()})
        except TypeError as error:
            raise ValueError(f"Custom({self.target!r}) does not take its arguments: {error}") from error


def custom_of(value: Any) -> Any:
    """Return a class, a function, or a `functools.partial` of one with keyword arguments, as a `Custom`: by
    its name where a module has it, else live; one that is defined again is another one. Return anything
    else as it is."""
    target = value.func if isinstance(value, partial) and not value.args else value
    if not isinstance(target, type | FunctionType) or target.__module__ == "builtins":
        return value
    name = f"{target.__module__}:{target.__qualname__}"
    arguments = value.keywords if isinstance(value, partial) else {}
    if target.__module__ != "__main__" and _imported(name) is target:
        return Custom(name, arguments)
    lives = (live for live, known in _LIVE.items() if known is target)
    live = next(lives, f"{secrets.token_hex(4)}-{len(_LIVE)}")  # by chance, unlike that of a forked process
    _LIVE[live] = target
    return Custom(name, arguments, live)


def _imported(name: str) -> Any:
    """Return what is called "module:name" in the modules that are imported; None where there is none."""
    module, _, path = name.partition(":")
    target: Any = sys.modules.get(module)
    for part in path.split("."):
        target = getattr(target, part, None)
    return target


_TRUSTED: Final[set[str]] = set()
"""The targets that this process trusts, besides those that its own program names."""


def trust(*targets: str) -> None:
    """Trust code of somebody's own, "module:Class" each, from now on and in the whole process.

    Recipes, runs and studies that name it can then be read, and may import it.
    """
    _TRUSTED.update(targets)


@contextmanager
def trusting(targets: Iterable[str]) -> Iterator[None]:
    """Trust code of somebody's own, "module:Class" each, only within a block: for tests."""
    before = set(_TRUSTED)
    _TRUSTED.update(targets)
    try:
        yield
    finally:
        _TRUSTED.intersection_update(before)


def trusted() -> tuple[str, ...]:
    """Return the targets that this process trusts, for processes that it starts."""
    return tuple(sorted(_TRUSTED))


OWN_METRICS: Final[dict[str, Mapping[str, str]]] = {}
"""What metrics of the user's own are called: "title" and "unit" by name, as the recipe that this process read
last says."""


def words_of_metric(metric: Custom) -> dict[str, str]:
    """Return "title" and "unit" of a metric of the user's own, as far as its function has such attributes.

    Raises:
        ValueError: if one is no text.
    """
    function = metric.resolve()
    words = {name: getattr(function, name) for name in ("title", "unit") if hasattr(function, name)}
    for name, word in words.items():
        if not isinstance(word, str):
            raise ValueError(f"{metric.target}.{name} is {shown(word)}; allowed: a text")
    return words


def custom_targets(table: object) -> list[str]:
    """Return the targets of all `Custom` in a table that are imported by their names, sorted."""
    return sorted({str(entry.get("target")) for entry in _tables_of_customs(table) if not entry.get("live")})


def live_targets(table: object) -> list[str]:
    """Return what is called the targets of all `Custom` in a table that are live, sorted."""
    entries = _tables_of_customs(table)
    return sorted({_on_a_line(str(entry.get("target"))) for entry in entries if entry.get("live")})


def _on_a_line(text: str) -> str:
    """A text of a stranger's as a message or a terminal can show it."""
    return "".join(sign if sign.isprintable() else "?" for sign in text)


def refuse_live(table: object, *, of_others: bool = False, where: str = "the experiment") -> None:
    """Raise a ValueError, by their names, for what a table has of live classes and functions.

    Args:
        of_others: only for those that this process does not have.
        where: what the table is called in messages.
    """
    entries = [entry for entry in _tables_of_customs(table) if entry.get("live")]
    refused = [entry for entry in entries if not (of_others and str(entry["live"]) in _LIVE)]
    if refused:
        raise ValueError(
            f"{where} has {', '.join(live_targets(refused))}, which only the process that it was handed to "
            "live can use; allowed: a class or function at the top of a module, which has a name"
        )


def described(table: object) -> list[str]:
    """Return in words what a table has of code of the user's own: "laws:RichPay (fee 2.0): The rich pay".

    The sentence is the first line of a docstring. Nothing is imported to be described: without its module
    there is the name alone.
    """
    entries = _tables_of_customs(table)
    parts = ((entry["target"], entry.get("arguments", {}), entry.get("live", "")) for entry in entries)
    customs = (Custom(*part) for part in parts)
    return list(dict.fromkeys(map(_in_words, customs)))


def _in_words(custom: Custom) -> str:
    arguments = ", ".join(f"{name} {shown(value)}" for name, value in custom.arguments.items())
    words = f"{custom.target} ({arguments})" if arguments else custom.target
    target = _LIVE.get(custom.live) if custom.live else _imported(custom.target)
    lines = str(getattr(target, "__doc__", None) or "").strip().splitlines()
    words = f"{words}: {lines[0].rstrip('.')}" if lines else words
    return _on_a_line(words)


def refuse_targets(table: object) -> None:
    """Raise a ValueError for a table that would import what this process does not trust, or that has what
    another process was handed live."""
    refuse_live(table, of_others=True)
    refused = [target for target in custom_targets(table) if target not in _TRUSTED]
    if refused:
        refused = list(map(_on_a_line, refused))
        flags = " ".join(f"--allow {target}" for target in refused)
        names = ", ".join(map(repr, refused))
        raise ValueError(
            f"{', '.join(refused)} would be imported, which is code of somebody's own; if you trust it: "
            f"{flags} (in Python cprl.trust({names}))"
        )


def _tables_of_customs(table: object) -> Iterator[Mapping[str, Any]]:
    if isinstance(table, Mapping):
        entries: Any = table
        if table.get("kind") == "Custom":
            yield table
            entries = table.get("arguments")
        for entry in entries.values() if isinstance(entries, Mapping) else ():
            yield from _tables_of_customs(entry)
    elif isinstance(table, list | tuple):
        for entry in table:
            yield from _tables_of_customs(entry)


_IMPORTED: Final[dict[str, tuple[object, str | None]]] = {}
"""The text of each module that was imported, with its `__spec__`, which is another after a reload."""


def source_of(module: str) -> str | None:
    """Return the text of a module, without importing it; of one that is imported, the text that runs.

    A file that is edited after a `Custom` of it was made does not change it before it is imported anew. None
    where there is no file, e.g. for what was typed into a notebook.
    """
    imported = sys.modules.get(module)
    try:
        spec = find_spec(module) if imported is None else imported.__spec__
        loader: Any = spec.loader if spec is not None else getattr(imported, "__loader__", None)
        if imported is not None and module in _IMPORTED and _IMPORTED[module][0] is spec:
            return _IMPORTED[module][1]
        text: str | None = loader.get_source(module)
    except (ImportError, AttributeError, ValueError):
        return None
    if imported is not None:
        _IMPORTED[module] = spec, text
    return text


class _Repr(reprlib.Repr):
    """Short, and without what objects say of themselves: by their class."""

    def repr_instance(self, x: Any, level: int) -> str:
        if isinstance(x, type):
            return f"the class {x.__name__}"
        plain_kinds = type(None), bool, float, complex, bytes, range
        return super().repr_instance(x, level) if type(x) in plain_kinds else f"a {type(x).__name__}"


_REPR: Final = _Repr()
_REPR.maxlevel, _REPR.maxtuple, _REPR.maxlist, _REPR.maxstring, _REPR.maxother = 4, 20, 20, 120, 120


def shown(value: object) -> str:
    """Return a value as a message shows it, on one line and not at full length; an object by its class."""
    try:
        return " ".join(_REPR.repr(value).split())
    except Exception:  # a user's object may raise anything, and an integer may have too many digits
        return f"a {type(value).__name__} that cannot be shown"


def made(value: Any, *positional: Any) -> Any:
    """Return what a `Custom` makes; anything else as it is."""
    return value.make(*positional) if isinstance(value, Custom) else value


def refuse_other_keys(value: Any, *, most: int = MOST_NESTED, depth: int = 0) -> None:
    """Refuse a value with tables by something else than text, which JSON would turn into text, and one that
    is nested too deep for functions that call themselves."""
    if depth > most:
        raise ValueError(f"it is nested more than {most} deep")
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, str):
                raise TypeError(f"a table has the key {key!r}; allowed: text")
    if isinstance(value, Mapping | list | tuple):
        for entry in value.values() if isinstance(value, Mapping) else value:
            refuse_other_keys(entry, most=most, depth=depth + 1)


def _table_of(value: object) -> Any:
    """Return a value of cprl as JSON can hold it; what `json.dumps` calls for what is not of JSON."""
    from cprl.values import to_config

    return to_config(value, f"a {type(value).__name__}")


def _argument(value: Any) -> Any:
    """Return an argument as a target gets it."""
    if isinstance(value, Mapping):
        from cprl.values import from_config, is_value

        return from_config(value) if is_value(value) else value
    if not isinstance(value, list):
        return value
    return [
        tuple(entry)
        if isinstance(entry, list) and all(isinstance(part, str) for part in entry)
        else _argument(entry)
        for entry in value
    ]
