"""Prints the oldest versions that `pyproject.toml` allows, as constraints for pip.

`make test-oldest` installs them into an environment of its own; see docs/install.md.
"""

import sys
import tomllib
from collections.abc import Iterator
from typing import Any

from packaging.requirements import Requirement
from packaging.version import Version
from places import ROOT

PYPROJECT = ROOT / "pyproject.toml"


def oldest(project: dict[str, Any], extras: list[str]) -> Iterator[str]:
    """A constraint `name==version` for each requirement of a project and of its extras.

    Args:
        project: the table "project" of a pyproject.toml.
        extras: names of extras; what an extra takes from other extras of the project is included.

    Raises:
        ValueError: if a requirement has no lower bound.
    """
    wanted, known = [*project["dependencies"]], set()
    waiting = list(extras)
    while waiting:
        extra = waiting.pop()
        if extra in known:
            continue
        known.add(extra)
        for text in project["optional-dependencies"][extra]:
            if Requirement(text).name == project["name"]:
                waiting += Requirement(text).extras
            else:
                wanted.append(text)
    for text in wanted:
        requirement = Requirement(text)
        lower = [part for part in requirement.specifier if part.operator in (">=", "==", "~=")]
        bounds = [Version(part.version) for part in lower]
        if not bounds:
            raise ValueError(f"{text!r} has no lower bound; allowed: NAME>=VERSION")
        marker = f"; {requirement.marker}" if requirement.marker else ""
        yield f"{requirement.name}=={max(bounds)}{marker}"


if __name__ == "__main__":
    table = tomllib.loads(PYPROJECT.read_text(encoding="utf-8"))["project"]
    print(*oldest(table, sys.argv[1:]), sep="\n")
