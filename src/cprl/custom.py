"""Custom: something of the user's own, as a text that a run's recipe can keep."""

import importlib
import json
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Any, Final

from cprl.checks import Check, check_nesting, checked, instance

_NAMES: Final = re.compile(r"[\w-]+(\.[\w-]+)*:\w+(\.\w+)*", re.ASCII)
_TARGET: Final = Check(
    lambda value: isinstance(value, str) and len(value) <= 1000 and bool(_NAMES.fullmatch(value)),
    '"module:Class"',
)


@dataclass(frozen=True)
class Custom:
    """A class or function of the user's own, by its name, with arguments that JSON can hold.

    An `Experiment` holds values only, so that its recipe says all of it: a transform, callback, logger,
    network, algorithm or game that is not one of cprl's is handed over like this. Nothing is imported before
    `make` is called; whoever loads a stored run names what it may import (`allow`).

    Args:
        target: "module:Class" or "module:function".
        arguments: its keyword arguments; strings, numbers, booleans, None, and lists and tables of them. A
            list of strings within a list becomes a tuple, so that nested TensorDict keys can be said:
            `{"in_keys": [["agents", "reward"]]}`.
    """

    target: str
    arguments: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        checked("Custom.target", self.target, _TARGET)
        checked("Custom.arguments", self.arguments, instance(Mapping, "a table of keyword arguments"))
        check_nesting(self.arguments, f"Custom.arguments of {self.target!r}")
        try:
            _refuse_other_keys(self.arguments)
            text = json.dumps(dict(self.arguments), allow_nan=False)
            object.__setattr__(self, "arguments", json.loads(text))
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"Custom.arguments of {self.target!r} cannot be kept as JSON: {error}"
            ) from error

    def __hash__(self) -> int:
        return hash((self.target, json.dumps(self.arguments, sort_keys=True)))

    def resolve(self) -> Any:
        """What the target names, imported."""
        module, _, name = self.target.partition(":")
        try:
            found: Any = importlib.import_module(module)
            for part in name.split("."):
                found = getattr(found, part)
        except (ImportError, AttributeError) as error:
            cure = "; allowed: a module in the folder where the command is given, or in one of PYTHONPATH"
            cure = cure if isinstance(error, ModuleNotFoundError) else ""
            raise ValueError(f"Custom({self.target!r}) cannot be imported: {error}{cure}") from error
        source_of(module)
        return found

    def make(self, *positional: Any) -> Any:
        """Calls the target with these arguments."""
        target = self.resolve()
        try:
            return target(*positional, **{name: _with_keys(value) for name, value in self.arguments.items()})
        except TypeError as error:
            raise ValueError(f"Custom({self.target!r}) does not take its arguments: {error}") from error


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


def made(value: Any, *positional: Any) -> Any:
    """What a `Custom` makes; anything else as it is."""
    return value.make(*positional) if isinstance(value, Custom) else value


def _refuse_other_keys(value: Any) -> None:
    """Raises a TypeError for tables by something else than text, which JSON would turn into text."""
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, str):
                raise TypeError(f"a table has the key {key!r}; allowed: text")
    if isinstance(value, Mapping | list | tuple):
        for own in value.values() if isinstance(value, Mapping) else value:
            _refuse_other_keys(own)


def _with_keys(value: Any) -> Any:
    """The same with each list of strings within a list as a tuple, a nested TensorDict key."""
    if not isinstance(value, list):
        return value
    return [tuple(own) if _is_key(own) else _with_keys(own) for own in value]


def _is_key(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(part, str) for part in value)
