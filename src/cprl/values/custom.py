"""Custom: something of the user's own, as a text that a run's recipe can keep; and what is allowed of it.

A recipe that somebody else made names code that loading it would import. Such a recipe is refused unless this
process trusts each name: `--allow module:Class` on the command line, `cprl.trust` in Python.
"""

import importlib
import json
import re
import reprlib
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Any, Final

_NAMES: Final = re.compile(r"[\w-]+(\.[\w-]+)*:\w+(\.\w+)*", re.ASCII)
_LONGEST_NAME: Final = 1000
MOST_NESTED: Final = 64


@dataclass(frozen=True)
class Custom:
    """A class or function of the user's own, by its name, with arguments that JSON can hold.

    An `Experiment` holds values only, so that its recipe says all of it: a transform, callback, logger,
    network, algorithm or game that is not one of cprl's is handed over like this. Nothing is imported before
    `make` is called; who loads a stored run says what it may import (`cprl.trust`).

    Args:
        target: "module:Class" or "module:function".
        arguments: its keyword arguments; strings, numbers, booleans, None, and lists and tables of them. A
            list of strings within a list becomes a tuple, so that nested TensorDict keys can be said:
            `{"in_keys": [["agents", "reward"]]}`.
    """

    target: str
    arguments: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        is_text = isinstance(self.target, str) and len(self.target) <= _LONGEST_NAME
        if not is_text or not _NAMES.fullmatch(self.target):
            raise ValueError(f'Custom.target is {shown(self.target)}; allowed: "module:Class"')
        if not isinstance(self.arguments, Mapping):
            came = shown(self.arguments)
            raise ValueError(f"Custom.arguments is {came}; allowed: a table of keyword arguments")
        try:
            refuse_other_keys(self.arguments)
            text = json.dumps(dict(self.arguments), allow_nan=False)
            object.__setattr__(self, "arguments", json.loads(text))
        except (TypeError, ValueError, RecursionError) as error:
            raise ValueError(
                f"Custom.arguments of {self.target!r} cannot be kept as JSON: {error}"
            ) from error

    def __hash__(self) -> int:
        return hash((self.target, json.dumps(self.arguments, sort_keys=True)))

    def resolve(self) -> Any:
        """Import the target and return it."""
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
            return target(*positional, **{name: _with_keys(value) for name, value in self.arguments.items()})
        except TypeError as error:
            raise ValueError(f"Custom({self.target!r}) does not take its arguments: {error}") from error


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
    """Return the targets of all `Custom` in a table, sorted."""
    return sorted({str(entry.get("target")) for entry in _tables_of_customs(table)})


def described(table: object) -> list[str]:
    """Return in words what a table has of code of the user's own: "laws:RichPay (fee 2.0): The rich pay".

    The sentence is the first line of a docstring. Nothing is imported to be described: without its module
    there is the name alone.
    """
    customs = (Custom(entry["target"], entry.get("arguments", {})) for entry in _tables_of_customs(table))
    return list(dict.fromkeys(map(_in_words, customs)))


def _in_words(custom: Custom) -> str:
    arguments = ", ".join(f"{name} {shown(value)}" for name, value in custom.arguments.items())
    words = f"{custom.target} ({arguments})" if arguments else custom.target
    module, _, name = custom.target.partition(":")
    target: Any = sys.modules.get(module)
    for part in name.split("."):
        target = getattr(target, part, None)
    lines = str(getattr(target, "__doc__", None) or "").strip().splitlines()
    words = f"{words}: {lines[0].rstrip('.')}" if lines else words
    return "".join(sign if sign.isprintable() else "?" for sign in words)


def refuse_targets(table: object) -> None:
    """Raise a ValueError for a table that would import what this process does not trust."""
    refused = [target for target in custom_targets(table) if target not in _TRUSTED]
    if refused:
        flags = " ".join(f"--allow {target}" for target in refused)
        names = ", ".join(map(repr, refused))
        raise ValueError(
            f"{', '.join(refused)} would be imported, which is code of somebody's own; if you trust it: "
            f"{flags} (in Python cprl.trust({names}))"
        )


def _tables_of_customs(table: object) -> Iterator[Mapping[str, Any]]:
    if isinstance(table, Mapping):
        if table.get("kind") == "Custom":
            yield table
        else:
            for entry in table.values():
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


def _with_keys(value: Any) -> Any:
    if not isinstance(value, list):
        return value
    return [
        tuple(entry)
        if isinstance(entry, list) and all(isinstance(part, str) for part in entry)
        else _with_keys(entry)
        for entry in value
    ]
