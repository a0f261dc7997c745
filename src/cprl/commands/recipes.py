"""`cprl recipe`, and recipes that `cprl run` takes by name."""

import sys
from pathlib import Path

from cprl.checks import shown
from cprl.commands.recipe import in_a_sentence
from cprl.system.output import OUT, printed, say
from cprl.system.shipped import PROGRAM, is_shipped, recipe_named, recipe_names, run_shipped, shipped_recipes


def recipe(name: str | None = None, /) -> None:
    """Lists the recipes that come with cprl, or prints one to be copied: cprl recipe commons > mine.py.

    Args:
        name: of the recipe that is printed.
    """
    if name is not None:
        OUT.write(recipe_named(name).text())
        OUT.flush()
        return
    recipes = [own for own in shipped_recipes().values() if own.runs]
    width = max(len(own.name) for own in recipes)
    for own in recipes:
        say(f"{own.name:<{width}}  {own.about}")


def run_by_name() -> bool:
    """Runs the recipe that the command line `cprl run NAME ...` names, with its own flags.

    Returns:
        Whether it named one; what is a file or a run is left to `cprl run`.

    Raises:
        SystemExit: for a name that is neither, and for whatever the recipe refuses.
    """
    if sys.argv[1:2] != ["run"] or len(sys.argv) < 3 or sys.argv[2].startswith("-"):
        return False
    name, words = sys.argv[2], sys.argv[3:]
    with in_a_sentence(f"{PROGRAM}{name}"):
        if not is_shipped(name):
            refuse_unknown(Path(name))
            return False
        run_shipped(name, words)
    return True


def refuse_unknown(path: Path) -> None:
    """Refuses what is no file or directory and so was meant as the name of a recipe, and a Python file."""
    if path.suffix == ".py" and path.is_file():
        raise ValueError(
            f"{path} is a recipe of your own, which Python runs: {printed(['python', str(path)])}"
        )
    if path.exists():
        return
    name = path.as_posix()
    if name not in shipped_recipes():
        raise ValueError(
            f"{shown(name)} is no file, no directory of a run and no recipe of cprl; allowed: those that are "
            f"there, and the recipes {recipe_names()}"
        )
    raise ValueError(f"the name of a recipe stands first, its flags behind it: {PROGRAM}{name} [FLAGS]")
