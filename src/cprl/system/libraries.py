"""What an upgrade of a library has taken away, said by name: the part, its version, and those that fit.

`cprl.system.compat` and `cprl.commons` use private parts of libraries through this.
"""

import logging
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import ModuleType

from cprl.system.output import in_notebook


def require(library: str, holder: object, *parts: str) -> None:
    """Check that a class or module of a library, by the name of its distribution, has these attributes."""
    name = getattr(holder, "__qualname__", None) or getattr(holder, "__name__", holder)
    for part in parts:
        with relying_on(library, f"{name}.{part}"):
            getattr(holder, part)


@contextmanager
def relying_on(library: str, part: str) -> Iterator[None]:
    """Say that a part is missing from a library where the block, the look-up of it, fails."""
    try:
        yield
    except (ImportError, AttributeError) as error:
        versions = fitting_versions(library)
        allowed = f"{library}{versions}" if versions else "the versions in pyproject.toml of cprl"
        raise ImportError(
            f"{library} {_installed(library)} has no {part}, on which cprl {_installed('cprl')} relies; "
            f"allowed: {allowed} (docs/install.md)"
        ) from error


def fitting_versions(library: str) -> str:
    """Return the versions of a library that cprl asks for, e.g. "<2.14,>=2.13"; "" if it does not say."""
    from importlib.metadata import PackageNotFoundError, requires

    from packaging.requirements import Requirement

    try:
        requirements = map(Requirement, requires("cprl") or [])
    except PackageNotFoundError:
        return ""
    return next((str(each.specifier) for each in requirements if each.name.lower() == library), "")


def _installed(library: str) -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(library)
    except PackageNotFoundError:
        return "(not installed)"


def quiet_in_notebooks() -> None:
    """Let what TorchRL imports not greet in a notebook with advice to install widgets, which cprl uses not at
    all: TorchRL imports Ray where that is installed, and Ray imports tqdm."""
    if in_notebook():
        warnings.filterwarnings("ignore", message="IProgress not found")
        logging.getLogger("ray.widgets.util").setLevel(logging.WARNING)


def when_imported(name: str, call: Callable[[], object]) -> None:
    """Call a function once a module has been imported: now, or after its import.

    So games are registered with Gymnasium and PettingZoo, which cprl does not import unless somebody uses
    them; Gymnasium 1.0 took its entry points away, and PettingZoo has none.
    """
    if name in sys.modules:
        call()
    else:
        sys.meta_path.insert(0, _Waiting(name, call))


class _Waiting:
    """A finder that leaves a module to the other finders, and calls a function after its import."""

    def __init__(self, name: str, call: Callable[[], object]) -> None:
        self._name = name
        self._call = call
        self._is_looking = False

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname != self._name or self._is_looking:
            return None
        self._is_looking = True  # the other finders are asked by the same function as this one
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
