"""The reference: what users import, by the docstrings of its packages, and the commands by their --help."""

import contextlib
import io
import os
import re
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from pkgutil import iter_modules
from types import ModuleType
from typing import Any, Final
from unittest import mock

FOLDER: Final = "reference"

REFERENCE: Final = {
    "cprl": "what most programs need",
    "commons": "the game: rules, boards, observations, the state",
    "keys": "the TensorDict entries",
    "envs": "TorchRL, PettingZoo, Gymnasium",
    "institutions": "rules that people make",
    "networks": "from observations to numbers",
    "objectives": "what agents want, and losses that TorchRL lacks",
    "policies": "agents that follow a rule",
    "algorithms": "what agents learn by",
    "learners": "the hyper-parameters",
    "population": "how each agent is specified",
    "experiment": "an experiment, a value; the published games and settings",
    "training": "the loop",
    "measuring": "metrics and statistics",
    "viewer": "recordings for the Rerun viewer",
    "evaluation": "stored agents in fresh worlds and among each other",
    "studies": "one experiment under many conditions",
    "web": "pages for a browser: episodes, reports, and games that people play",
    "experimental": "the waiting room: works, is tested, may change",
    "values": "frozen values, whose annotations say what a field allows, as tables; code of your own",
}
"""A page each, in reading order, and what it is about."""

_MODULES: Final = {
    "commons": ("maps", "named_games", "observation", "rules", "game", "spaces", "state"),
    "envs": ("make_env",),
    "experiment": ("presets",),
    "experimental": (
        *("schelling", "territory", "payoff_table", "solutions", "empirical_game", "exploit", "search"),
        "ray_executor",
    ),
    "learners": ("settings",),
    "measuring": ("social", "registry", "table", "statistics", "outcome"),
    "objectives": ("rewards",),
    "policies": ("scripted", "joint_policy", "decisions"),
    "training": ("training",),
    "values": ("custom",),
    "viewer": ("callback",),
}
"""Modules of a package that its page shows too, beside what the package exports."""

INTERNAL: Final = {"system", "pictures", "runs", "terminal", "commands", "__main__"}
"""Packages that no page shows: users reach what they hold by the names of `cprl` or by a command."""


def stage_reference(folder: Path) -> dict[str, str]:
    """Write the pages, and return the title and the file of each."""
    (folder / FOLDER).mkdir(parents=True, exist_ok=True)
    pages = {"API": f"{FOLDER}/api.md", "Commands": f"{FOLDER}/commands.md"}
    (folder / pages["API"]).write_text(_landing_page(), encoding="utf-8")
    (folder / pages["Commands"]).write_text(_commands_page(), encoding="utf-8")
    for name in REFERENCE:
        package = name if name == "cprl" else f"cprl.{name}"
        pages[package] = f"{FOLDER}/{package}.md"
        (folder / pages[package]).write_text(_package_page(package), encoding="utf-8")
    return pages


def _landing_page() -> str:
    """Return the values that a user writes, and all packages with what they are about."""
    text = f"# API\n\n{_LANDING}\n\n## All packages\n\n| package | what it is about |\n|---|---|\n"
    for name, about in REFERENCE.items():
        package = name if name == "cprl" else f"cprl.{name}"
        text += f"| [{package}]({package}.md) | {about} |\n"
    return text


_LANDING: Final = """Four values describe everything that you run.
They are frozen: `dataclasses.replace` makes a changed copy.

| value | what it says | to see it | page |
|---|---|---|---|
| `cprl.Game` | a map, its rules, what agents observe, its institutions | \
`cprl.CommonsEnv(game, worlds=1000)` | [cprl](cprl.md) |
| `Institution` | a rule that people make, such as `Quota` or `Tax` | \
`replace(game, institutions=(Quota(),))` | [cprl.institutions](cprl.institutions.md) |
| `cprl.Experiment` | a game, who plays, how long, how many replicas | `run = cprl.run(experiment)`, \
`cprl.load(run)` | [cprl](cprl.md) |
| `cprl.Study` | one experiment under many conditions | `cprl.run_study(study)` | [cprl](cprl.md) |

`cprl.presets` has the published games and settings by name.
[Commands](commands.md) are what the terminal offers."""


def _package_page(package: str) -> str:
    """Return what a package says of itself, and an entry for each public name, which mkdocstrings fills."""
    module = import_module(package)
    said, modules = _split(module.__doc__ or "")
    text = f"# {package}\n\n{said}\n"
    for path in _public_names(package):
        text += f"\n::: {path}\n"
    return f"{text}\n## Modules\n\n```text\n{modules}\n```\n" if modules else text


def _public_names(package: str) -> list[str]:
    """Return the full names of what a package exports or a module defines; then those of its modules."""
    module = import_module(package)
    exported = list(getattr(module, "__all__", ()))
    found = [
        _path_of(package, name)
        for name in (exported or _defined_by(module))
        if not _is_elsewhere(module, name)
    ]
    for name in _MODULES.get(package.removeprefix("cprl."), ()):
        below = import_module(f"{package}.{name}")
        found += [f"{below.__name__}.{own}" for own in getattr(below, "__all__", None) or _defined_by(below)]
    return found


def _defined_by(module: Any) -> list[str]:
    return [
        name
        for name, value in vars(module).items()
        if not name.startswith("_")
        and getattr(value, "__module__", None) == module.__name__
        and (isinstance(value, type) or callable(value))
    ]


def _is_elsewhere(module: Any, name: str) -> bool:
    """Return whether another page shows this, as of the modules that `cprl` exports, or none can."""
    return name.startswith("__") or isinstance(getattr(module, name), ModuleType)


def _path_of(package: str, name: str) -> str:
    """Return the full name; that of its definition where a module has the same name, as `make_env`."""
    module = import_module(package)
    if hasattr(module, "__path__") and find_spec(f"{package}.{name}"):
        value = getattr(module, name)
        return f"{value.__module__}.{value.__qualname__}"
    return f"{package}.{name}"


def _split(doc: str) -> tuple[str, str]:
    """Return the text of a package's docstring, and the list of modules in it, which is indented."""
    lines = doc.strip().splitlines()
    listed = [line.removeprefix("    ") for line in lines if line.startswith("    ")]
    text = [line for line in lines if not line.startswith("    ") and not line.endswith(":")]
    return "\n".join(text).strip(), "\n".join(listed)


def _commands_page() -> str:
    """`cprl --help`, and that of each command."""
    from cprl.commands.main import COMMANDS

    text = f"# Commands\n\n{help_of()}\n"
    for name in COMMANDS:
        text += f"\n## cprl {name}\n\n{help_of(name)}\n"
    return text


def help_of(*words: str) -> str:
    """Return what `cprl WORDS --help` prints, as a block of text."""
    from cprl.commands import main as cli

    out = io.StringIO()
    with (
        mock.patch.object(sys, "argv", ["cprl", *words, "--help"]),
        mock.patch.dict(os.environ, {"COLUMNS": "88", "NO_COLOR": "1"}),
        contextlib.redirect_stdout(out),
        contextlib.suppress(SystemExit),
    ):
        cli.main()
    text = re.sub(r"\x1b\[[0-9;]*m", "", out.getvalue()).strip("\n")
    lines = [line.rstrip() for line in text.splitlines()]
    return "```text\n" + "\n".join(lines) + "\n```"


def packages_there() -> set[str]:
    """Return the packages and modules right below `cprl`."""
    return {found.name for found in iter_modules(import_module("cprl").__path__)}
