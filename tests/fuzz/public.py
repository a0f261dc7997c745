"""What of cprl is public: what `__all__` exports, what a recipe can hold, what docs and recipes import or
name, and a few modules of which every function is for users."""

import ast
import inspect
import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages
from types import ModuleType
from typing import Any, Final

import cprl
from cprl.config import KINDS

ROOT: Final = Path(__file__).parents[2]
PAGES: Final = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))

WHOLE: Final = ("cprl.measuring.phases", "cprl.measuring.statistics", "cprl.spaces")
"""Modules whose functions are for users, though no `__all__` lists them."""

MORE: Final = ("cprl.config.to_config", "cprl.config.from_config")
"""Single functions likewise."""

NOT_CALLED: Final = {
    "cprl.algorithms.base:Algorithm": "abstract; its subclasses have rows",
    "cprl.algorithms.base:OffPolicy": "abstract; its subclasses have rows",
    "cprl.algorithms.base:OnPolicy": "abstract; its subclasses have rows",
    "cprl.algorithms.base:TeamAlgorithm": "abstract; its subclasses have rows",
    "cprl.callbacks:Callback": "a Protocol, which nobody calls",
    "cprl.callbacks:SavesTraining": "a Protocol, which nobody calls",
    "cprl.population:refuse_sharing": "of values that are made already",
    "cprl.studies.executors.in_process:Executor": "a Protocol, which nobody calls",
    "cprl.theory.worth:Worth": "a Protocol, which nobody calls",
}
"""Public names without a row, each with the reason."""


def public_names() -> dict[str, Any]:
    """Every public class and function, as "module:name" of where it is defined."""
    found = {}
    for value in (
        *_exported(),
        *KINDS.values(),
        *map(import_module, WHOLE),
        *map(_at, MORE),
        *_in_docs(),
        *_in_recipes(),
    ):
        for own in _members(value) if isinstance(value, ModuleType) else (value,):
            if inspect.isclass(own) or inspect.isfunction(own):
                found[name_of(own)] = own
    ours = (name for name in sorted(found) if name.startswith("cprl.") and name not in NOT_CALLED)
    return {name: found[name] for name in ours}


def name_of(value: Any) -> str:
    """Where a class or function is defined, "module:name"."""
    return f"{value.__module__}:{value.__qualname__}"


def _exported() -> Iterator[Any]:
    """What the packages of cprl list in `__all__`."""
    for module in walk_packages(cprl.__path__, "cprl."):
        own = import_module(module.name)
        yield from (getattr(own, name) for name in getattr(own, "__all__", ()))
    yield from (getattr(cprl, name) for name in cprl.__all__)


def _members(module: ModuleType) -> Iterator[Any]:
    """The classes and functions of a public module: what it defines and does not underscore."""
    if not module.__name__.startswith("cprl"):
        return
    for name, value in vars(module).items():
        if not name.startswith("_") and getattr(value, "__module__", None) == module.__name__:
            yield value


def _in_docs() -> Iterator[Any]:
    """What README and docs import, or name by its path in inline code."""
    for page in PAGES:
        text = page.read_text()
        for code in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
            yield from _imported(code)
        for path in re.findall(r"(?<![\w.])cprl(?:\.\w+)+", text):
            value = _at(path)
            if inspect.isclass(value) or (inspect.isfunction(value) and "." not in value.__qualname__):
                yield value


def _in_recipes() -> Iterator[Any]:
    """What recipes import: they are there to be copied."""
    for path in sorted((ROOT / "recipes").glob("*.py")):
        yield from _imported(path.read_text())


def _imported(code: str) -> Iterator[Any]:
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "cprl":
            for alias in node.names:
                yield _at(f"{node.module}.{alias.name}")


def _at(path: str) -> Any:
    """What a dotted path leads to, as far as it leads; None for nothing of cprl."""
    value: Any = cprl
    for part in path.split(".")[1:]:
        if not hasattr(value, part):
            try:
                value = import_module(f"{value.__name__}.{part}")
                continue
            except (ImportError, AttributeError):
                return None
        value = getattr(value, part)
    return value
