"""What an upgrade of a library has taken away, said by name: the part, its version, and those that fit.

`cprl.system.compat` and `cprl.commons.compiled` use private parts of libraries through this.
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, requires, version


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
    try:
        wanted = requires("cprl") or []
    except PackageNotFoundError:
        wanted = []
    for requirement in wanted:
        found = re.fullmatch(r"([\w.-]+)(?:\[[^\]]*\])?\s*([^;]*?)\s*(?:;.*)?", requirement)
        if found is not None and found[1].lower() == library:
            return found[2]
    return ""


def _installed(library: str) -> str:
    try:
        return version(library)
    except PackageNotFoundError:
        return "(not installed)"
