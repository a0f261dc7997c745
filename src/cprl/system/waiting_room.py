"""Access to `cprl.experimental` by name. No other package imports it, so that its modules may change freely.

`experimental("Ray")` imports and returns the executor for Ray, for example.
"""

from importlib import import_module
from typing import Any, Final

EXPERIMENTAL_COMMANDS: Final = ("egta", "exploit", "schelling", "search", "visits")
"""The names of the experimental commands, which are functions of `cprl.experimental.commands`."""
EXPERIMENTAL_PARTS: Final = {
    **{name: f"commands:{name}" for name in EXPERIMENTAL_COMMANDS},
    "export_turns": "export_turns:export_turns",
    "exhibition": "exhibition:exhibition",
    "map_figures": "factor_maps:map_figures",
    "Ray": "ray_executor:Ray",
}
"""The parts that other packages use, by name: "module:attribute" in `cprl.experimental`."""


def experimental(name: str) -> Any:
    """Import and return a part of `cprl.experimental`, by its name in `EXPERIMENTAL_PARTS`."""
    module, _, attribute = EXPERIMENTAL_PARTS[name].partition(":")
    return getattr(import_module(f"cprl.experimental.{module}"), attribute)
