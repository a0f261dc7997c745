"""Access to `cprl.experimental` by name: no other package imports it, so its modules may change freely."""

from importlib import import_module
from typing import Any


def experimental(place: str) -> Any:
    """Import and return what stands at a place in `cprl.experimental`, e.g. "ray_executor.Ray"."""
    module, _, name = place.partition(".")
    return getattr(import_module(f"cprl.experimental.{module}"), name)
