"""What an upgrade of a library has taken away, said by name: the part, its version, and those that fit.

`cprl.system.compat` and `cprl.commons.compiled` use private parts of libraries through this.
"""

import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import ModuleType


def require(library: str, holder: object, *parts: str) -> None:
    """Checks that a class or module of a library has parts that cprl relies on.

    Args:
        library: the name of its distribution.
        holder: the class or module.
        parts: the names of attributes.
    """
    for part in parts:
        if not hasattr(holder, part):
            name = getattr(holder, "__qualname__", None) or getattr(holder, "__name__", holder)
            raise ImportError(missing(library, f"{name}.{part}"))


@contextmanager
def relying_on(library: str, part: str) -> Iterator[None]:
    """While it is open, a part that cannot be imported or found is said to be missing from a library.

    Only the look-up of the part belongs inside.
    """
    try:
        yield
    except (ImportError, AttributeError) as error:
        raise ImportError(missing(library, part)) from error


def missing(library: str, part: str) -> str:
    """A sentence that says which part of a library is missing, and which versions of it fit."""
    fitting = fitting_versions(library)
    allowed = f"{library}{fitting}" if fitting else "the versions in pyproject.toml of cprl"
    return (
        f"{library} {_installed(library)} has no {part}, on which cprl {_installed('cprl')} relies; allowed: "
        f"{allowed} (docs/upgrading.md)"
    )


def fitting_versions(library: str) -> str:
    """The versions of a library that cprl asks for, e.g. "<2.14,>=2.13"; "" if it does not say."""
    from importlib.metadata import PackageNotFoundError, requires

    try:
        wanted = requires("cprl") or []
    except PackageNotFoundError:
        wanted = []
    for requirement in wanted:
        parts = re.fullmatch(r"([\w.-]+)(?:\[[^\]]*\])?\s*([^;]*?)\s*(?:;.*)?", requirement)
        if parts is not None and parts[1].lower() == library:
            return parts[2]
    return ""


def _installed(library: str) -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(library)
    except PackageNotFoundError:
        return "(not installed)"


def when_imported(name: str, call: Callable[[], object]) -> None:
    """Call a function as soon as a module is imported: now if it is, else once it has been.

    What cprl tells a library costs nothing where nobody uses that library.
    """
    if name in sys.modules:
        call()
    else:
        sys.meta_path.insert(0, _Waiting(name, call))


class _Waiting:
    """Finds a module as Python does without it, and calls a function behind its import; looking for a module
    does not import it."""

    def __init__(self, name: str, call: Callable[[], object]) -> None:
        self._name, self._call = name, call
        self._is_looking = False

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname != self._name or self._is_looking:
            return None
        self._is_looking = True
        try:
            spec = find_spec(fullname)
        finally:
            self._is_looking = False
        if spec is None or spec.loader is None:
            return spec
        execute = spec.loader.exec_module

        def execute_and_call(module: ModuleType) -> None:
            sys.meta_path.remove(self)
            execute(module)
            self._call()

        spec.loader.exec_module = execute_and_call  # type: ignore[method-assign]
        return spec
