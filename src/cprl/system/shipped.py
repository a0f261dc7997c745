"""The recipes that come with cprl: at the top of a checkout, or in the package that a wheel installs.

A recipe is named by its path without ".py": `commons`, `study/time_out`.
"""

import ast
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PureWindowsPath
from shutil import which
from types import ModuleType
from typing import Final

from cprl.values import meant

PROGRAM: Final = "cprl run "
"""How the program of a shipped recipe begins, where a script has its path."""

_PACKAGE: Final = Path(__file__).parents[1]


@dataclass(frozen=True)
class Recipe:
    """A recipe that comes with cprl, or a module that recipes share."""

    name: str
    """Its path without ".py", e.g. "study/time_out"."""
    path: Path

    @property
    def folder(self) -> str:
        """The folder of its name, e.g. "study"; "" for none."""
        return self.name.rpartition("/")[0]

    @cached_property
    def source(self) -> str:
        return self.path.read_text(encoding="utf-8")

    @property
    def runs(self) -> bool:
        """Whether it is run; otherwise other recipes import it."""
        return 'if __name__ == "__main__":' in self.source

    @property
    def about(self) -> str:
        return self.source.partition("\n")[0].strip('"')

    def text(self) -> str:
        """Return its source, with a line by which a copy finds the modules of its folder that it imports."""
        imports = [
            node for node in ast.parse(self.source).body if isinstance(node, ast.Import | ast.ImportFrom)
        ]
        names = {alias.name for node in imports if isinstance(node, ast.Import) for alias in node.names}
        names |= {node.module or "" for node in imports if isinstance(node, ast.ImportFrom)}
        beside = sorted(names & {path.stem for path in self.path.parent.glob("*.py")})
        if not self.folder or not beside:
            return self.source
        lines, first = self.source.splitlines(keepends=True), imports[0].lineno - 1
        needed = ", ".join(f"{name}.py" for name in beside)
        line = (
            "from cprl.system.shipped import import_from\n\n"
            f"# {needed} of that folder; one beside this file comes first.\n"
            f'import_from("{self.folder}")\n\n'
        )
        return "".join([*lines[:first], line, *lines[first:]])


def recipes_folder() -> Path:
    """The folder that holds the recipes; a FileNotFoundError where the source was copied alone."""
    for folder in (_PACKAGE / "recipes", _PACKAGE.parents[1] / "recipes"):
        if folder.is_dir():
            return folder
    raise FileNotFoundError(f"the recipes of cprl are neither in {_PACKAGE} nor in a checkout around it")


def shipped_recipes() -> dict[str, Recipe]:
    folder = recipes_folder()
    paths = sorted(folder.rglob("*.py"), key=lambda path: (len(path.relative_to(folder).parts), path))
    names = [path.relative_to(folder).with_suffix("").as_posix() for path in paths]
    return {name: Recipe(name, path) for name, path in zip(names, paths, strict=True)}


def recipe_named(name: str) -> Recipe:
    recipes = shipped_recipes()
    if name not in recipes:
        hint = meant(name, recipes) or "; cprl recipe lists them"
        raise ValueError(f"there is no recipe {name!r}{hint}")
    return recipes[name]


def is_shipped(word: str) -> bool:
    """Whether a word names a recipe, and no file or directory of a run that is there."""
    path = Path(word)
    with suppress(OSError, ValueError):  # too long, or with a null, for a path
        if path.is_file() or (path / "recipe.json").exists():
            return False
    return word in shipped_recipes()


def run_shipped(name: str, words: Sequence[str]) -> None:
    """Runs a recipe as `python RECIPE.py` does, as the main module of this process."""
    recipe = recipe_named(name)
    if not recipe.runs:
        raise ValueError(f"{name} runs nothing: other recipes import it; cprl recipe {name} prints it")
    module = ModuleType("__main__")
    module.__file__ = str(recipe.path)
    code = compile(recipe.source, str(recipe.path), "exec")
    before = sys.argv, sys.path[:], sys.modules["__main__"]
    sys.argv, sys.modules["__main__"] = [f"{PROGRAM}{name}", *words], module
    sys.path.insert(0, str(recipe.path.parent))
    try:
        exec(code, vars(module))
    finally:
        sys.argv, sys.path[:], sys.modules["__main__"] = before


def import_from(folder: str) -> None:
    """Lets the modules that the recipes of a folder share be imported by name, as copies of recipes do;
    modules beside the script that runs come first."""
    folders = sorted({recipe.folder for recipe in shipped_recipes().values()} - {""})
    if folder not in folders:
        raise ValueError(f"folder is {folder!r}; allowed: {', '.join(folders)}")
    script = getattr(sys.modules["__main__"], "__file__", None)
    beside = None if script is None else Path(script).resolve().parent
    # Libraries may have put folders before that of the script, as Ray does.
    places = [place for place, path in enumerate(sys.path) if path and Path(path).resolve() == beside]
    sys.path.insert(places[0] + 1 if places else 0, str(recipes_folder() / folder))


def program_of(program: str) -> str:
    """What messages call a program: the name of a script, or `cprl run NAME`."""
    return program if program.startswith(PROGRAM) else Path(program).name


def is_cprl(program: str) -> bool:
    """Whether a program, as a command line names it on any platform, is the command `cprl`."""
    return PureWindowsPath(program).name in ("cprl", "cprl.exe")


def named_command(words: Sequence[str]) -> list[str]:
    """A command line, script first, as words with the program first: this Python, or "cprl" by its name."""
    if words[0].startswith(PROGRAM):
        return [*words[0].split(" "), *words[1:]]
    return ["cprl", *words[1:]] if is_cprl(words[0]) else [sys.executable, *words]


def command_of(words: Sequence[str]) -> list[str]:
    """A command line, script first, as words that can be typed here."""
    program, *others = named_command(words)
    return [*cprl_here(), *others] if program == "cprl" else [program, *others]


def cprl_here() -> list[str]:
    """How the command `cprl` of this Python is called: by its name where the shell finds it, else by path,
    and by `python -m cprl` where there is no such script beside Python."""
    path = which("cprl", path=str(Path(sys.executable).parent))
    if path is None:
        return [sys.executable, "-m", "cprl"]
    if path == which("cprl"):
        return ["cprl"]
    script, here = Path(path), Path.cwd()
    # In the folder of the script its name alone would be looked up on the path.
    is_below = script.is_relative_to(here) and script.parent != here
    return [str(script.relative_to(here) if is_below else script)]
