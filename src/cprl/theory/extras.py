"""Packages that come with the extra "theory", imported where they are used."""

from importlib import import_module
from importlib.util import find_spec
from typing import Any, Final

_PACKAGES: Final = {"open_spiel": "alpha-rank and replicator dynamics", "nashpy": "equilibria"}


def check_extras() -> None:
    """Raises a ModuleNotFoundError, which says how to install it, if OpenSpiel or nashpy is missing."""
    for package in _PACKAGES:
        _check(package)


def extra(module: str) -> Any:
    """A module of OpenSpiel or nashpy.

    Raises:
        ModuleNotFoundError: if its package is not installed; says how to install it.
    """
    _check(module.partition(".")[0])
    return import_module(module)


def _check(package: str) -> None:
    if find_spec(package) is None:
        raise ModuleNotFoundError(
            f'{_PACKAGES[package]} need {package}, which is not installed; run pip install "cprl[theory]"'
        )
