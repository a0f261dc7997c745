"""The recipes that come with cprl: at the top of a checkout, or in the package that a wheel installs.

A recipe is named by its path without ".py": `commons`, `study/exploration`.
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

from cprl.values import did_you_mean

PROGRAM: Final = "cprl run "
"""The beginning of `sys.argv[0]` while a shipped recipe runs: "cprl run commons". A script of the user has
its path there. So messages and the commands that they print name the recipe as the user called it."""

_PACKAGE: Final = Path(__file__).parents[1]


@dataclass(frozen=True)
class Recipe:
    """A recipe that comes with cprl, or a module that recipes share."""

    name: str
    """The path among the recipes without ".py", e.g. "study/exploration"."""
    path: Path
    """The file."""

    @property
    def folder(self) -> str:
        """Return the folder among the recipes that holds it, e.g. "study"; "" for none."""
        return self.name.rpartition("/")[0]

    @cached_property
    def source(self) -> str:
        """Return the text of the file."""
        return self.path.read_text(encoding="utf-8")

    @property
    def is_runnable(self) -> bool:
        """Return whether it can be run; the others are modules that recipes import."""
        return 'if __name__ == "__main__":' in self.source

    @property
    def summary(self) -> str:
        """Return the first line of the docstring."""
        return self.source.partition("\n")[0].strip('"')

    def portable_source(self) -> str:
        """Return the source for a copy outside its folder: before the first import it calls `import_from`, if
        the recipe imports modules of its folder."""
        imports = [
            node for node in ast.parse(self.source).body if isinstance(node, ast.Import | ast.ImportFrom)
        ]
        siblings = self._imported_siblings(imports)
        if not self.folder or not siblings:
            return self.source
        lines = self.source.splitlines(keepends=True)
        first_import = imports[0].lineno - 1
        files = ", ".join(f"{name}.py" for name in siblings)
        call = (
            "from cprl.system.shipped import import_from\n\n"
            f"# {files} of that folder; one beside this file comes first.\n"
            f'import_from("{self.folder}")\n\n'
        )
        return "".join([*lines[:first_import], call, *lines[first_import:]])

    def _imported_siblings(self, imports: Sequence[ast.Import | ast.ImportFrom]) -> list[str]:
        """Return the names of the modules in the recipe's folder that it imports."""
        imported: set[str] = set()
        for node in imports:
            if isinstance(node, ast.Import):
                imported.update(alias.name for alias in node.names)
            else:
                imported.add(node.module or "")
        return sorted(imported & {path.stem for path in self.path.parent.glob("*.py")})


def recipes_folder() -> Path:
    """Return the folder that holds the recipes.

    Raises:
        FileNotFoundError: if the package was copied without its recipes.
    """
    for folder in (_PACKAGE / "recipes", _PACKAGE.parents[1] / "recipes"):
        if folder.is_dir():
            return folder
    raise FileNotFoundError(f"the recipes of cprl are neither in {_PACKAGE} nor in a checkout around it")


def shipped_recipes() -> dict[str, Recipe]:
    """Return all recipes by name, those at the top of the folder first."""
    folder = recipes_folder()
    paths = sorted(folder.rglob("*.py"), key=lambda path: (len(path.relative_to(folder).parts), path))
    names = [path.relative_to(folder).with_suffix("").as_posix() for path in paths]
    return {name: Recipe(name, path) for name, path in zip(names, paths, strict=True)}


def recipe_named(name: str) -> Recipe:
    """Return the recipe of this name.

    Raises:
        ValueError: if there is none; the message names similar ones.
    """
    recipes = shipped_recipes()
    if name not in recipes:
        hint = did_you_mean(name, recipes) or "; cprl recipe lists them"
        raise ValueError(f"there is no recipe {name!r}{hint}")
    return recipes[name]


def is_shipped(word: str) -> bool:
    """Return whether a word of the command line names a recipe, rather than a file or the directory of a
    run."""
    path = Path(word)
    with suppress(OSError, ValueError):  # too long, or with a null, for a path
        if path.is_file() or (path / "recipe.json").exists():
            return False
    return word in shipped_recipes()


def run_shipped(name: str, words: Sequence[str]) -> None:
    """Run a recipe as `python RECIPE.py` does, as the main module of this process."""
    recipe = recipe_named(name)
    if not recipe.is_runnable:
        raise ValueError(f"{name} runs nothing: other recipes import it; cprl recipe {name} prints it")
    module = ModuleType("__main__")
    module.__file__ = str(recipe.path)
    code = compile(recipe.source, str(recipe.path), "exec")
    before = sys.argv, sys.path[:], sys.modules["__main__"]
    sys.argv = [f"{PROGRAM}{name}", *words]
    sys.modules["__main__"] = module
    sys.path.insert(0, str(recipe.path.parent))
    try:
        exec(code, vars(module))
    finally:
        sys.argv, sys.path[:], sys.modules["__main__"] = before


def import_from(folder: str) -> None:
    """Make the modules in a folder of recipes importable by name, as copies of recipes need it. Modules
    beside the running script are found first."""
    folders = sorted({recipe.folder for recipe in shipped_recipes().values()} - {""})
    if folder not in folders:
        raise ValueError(f"folder is {folder!r}; allowed: {', '.join(folders)}")
    sys.path.insert(_index_after_script_folder(), str(recipes_folder() / folder))


def _index_after_script_folder() -> int:
    """Return the index in `sys.path` after the folder of the running script; 0 if it is not there. Libraries
    may have put other folders before it, as Ray does."""
    script = getattr(sys.modules["__main__"], "__file__", None)
    if script is None:
        return 0
    folder = Path(script).resolve().parent
    for index, path in enumerate(sys.path):
        if path and Path(path).resolve() == folder:
            return index + 1
    return 0


def program_name(program: str) -> str:
    """Return how messages name a program, the first word of `sys.argv`: "my_recipe.py" for the path of a
    script, "cprl run commons" as it is."""
    return program if program.startswith(PROGRAM) else Path(program).name


def is_cprl(program: str) -> bool:
    """Return whether a program, the first word of `sys.argv`, is the command `cprl`, on any platform."""
    return PureWindowsPath(program).name in ("cprl", "cprl.exe")


def command_line(words: Sequence[str]) -> list[str]:
    """Return `sys.argv` as a command line that begins with a program: "cprl" by its name, or the path of this
    Python before that of a script."""
    if words[0].startswith(PROGRAM):
        return [*words[0].split(" "), *words[1:]]
    return ["cprl", *words[1:]] if is_cprl(words[0]) else [sys.executable, *words]


def typed_command_line(words: Sequence[str]) -> list[str]:
    """Return `sys.argv` as a command line that works in the user's shell as it stands, see `cprl_command`."""
    program, *others = command_line(words)
    return [*cprl_command(), *others] if program == "cprl" else [program, *others]


def cprl_command() -> list[str]:
    """Return the words that call the command `cprl` of this Python: "cprl" if the shell finds it by this
    name, else its path, or `python -m cprl` if there is no such script beside Python."""
    path = which("cprl", path=str(Path(sys.executable).parent))
    if path is None:
        return [sys.executable, "-m", "cprl"]
    if path == which("cprl"):
        return ["cprl"]
    script = Path(path)
    here = Path.cwd()
    # A bare name would be looked up on the PATH, so the path is not shortened in the script's own folder.
    if script.is_relative_to(here) and script.parent != here:
        script = script.relative_to(here)
    return [str(script)]
