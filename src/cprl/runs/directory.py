"""A run is a directory; `recipe.json` in it says what was run, with what, when and from which commit."""

import json
import platform
import shlex
import subprocess
import sys
from collections.abc import Mapping, Set
from dataclasses import fields, is_dataclass
from datetime import datetime
from enum import Enum
from importlib.metadata import PackageNotFoundError, version
from itertools import count
from math import isfinite
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from cprl.runs.files import write_atomically

FILE_NAME: Final = "recipe.json"

PACKAGES: Final = ("cprl", "torch", "torchrl", "tensordict", "numpy", "numba", "rerun-sdk")
"""The packages whose versions are kept."""


def start_run(out: Path | None, name: str, recipe: Mapping[str, object], *, resume: bool = False) -> Path:
    """Makes the directory of a run and writes down what is about to happen.

    Args:
        out: the directory, new or empty; None for `runs/<name>-<YYYYmmdd-HHMMSS>` where we stand.
        name: the recipe's name.
        recipe: its arguments by name, of the types that `to_jsonable` takes.
        resume: whether the run in `out` is gone on with, which was stopped and has the same recipe.

    Returns:
        The directory. Its `recipe.json` holds the recipe's name, the arguments, versions, the git commit of
        the directory where we stand (None outside a checkout; dirty where a tracked file was changed), the
        time and the command.

    Raises:
        FileExistsError: where `out` is not empty, unless it is gone on with.
        ValueError: where the name cannot be that of a directory; where there is nothing to go on with, or
            the run was made with another recipe.
    """
    if Path(name).name != name:
        raise ValueError(f'"{name}" names a recipe; a name without slashes is wanted')
    if resume:
        return _same_run(out, name, to_jsonable(recipe))
    started = datetime.now().astimezone()
    told = {
        "recipe": name,
        "arguments": to_jsonable(recipe),
        "versions": versions(),
        "git": git_state(),
        "started": started.isoformat(timespec="seconds"),
        "command": shlex.join(sys.argv),
    }
    directory = _new_directory(name, started) if out is None else _empty_directory(Path(out))
    write_json(directory / FILE_NAME, told)
    return directory


def write_json(path: Path, told: object) -> None:
    """Writes what `to_jsonable` gave, all or nothing."""
    text = json.dumps(told, indent=2, allow_nan=False) + "\n"
    write_atomically(path, lambda file: file.write(text.encode()))


def read_json(path: Path) -> dict[str, Any]:
    """What `write_json` wrote.

    Raises:
        FileNotFoundError: where there is none.
        ValueError: where it cannot be read.
    """
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path} holds no JSON: {error}") from error
    if not isinstance(told, dict):
        raise ValueError(f"{path} holds no table")
    return told


def resume_command(run: Path) -> str:
    """The command line that goes on with a run which this process began, or went on with."""
    given, left = list(sys.argv), []
    while given:
        word = given.pop(0)
        if word == "--out" and given:
            given.pop(0)
        elif word not in ("--go-on", "--no-go-on") and not word.startswith("--out="):
            left.append(word)
    return shlex.join([sys.executable, *left, "--out", str(run), "--go-on"])


def read_recipe(run: Path) -> dict[str, Any]:
    """What `start_run` wrote.

    Raises:
        ValueError: where there is no run, or its recipe cannot be read; names file and reason.
    """
    path = Path(run) / FILE_NAME
    try:
        told: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(told["arguments"], dict):
            raise TypeError('"arguments" is no table')
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is no recipe of a run: {error!r}") from error
    return told


def _same_run(out: Path | None, name: str, arguments: Any) -> Path:
    """The directory of a stopped run, if it is of this recipe."""
    if out is None:
        raise ValueError("go_on wants the directory of the run as out")
    told = read_recipe(Path(out))
    if told.get("recipe") != name:
        raise ValueError(f"{out} is a run of {told.get('recipe')!r}; this is {name!r}")
    came, kept = json.loads(json.dumps(arguments)), told["arguments"]
    changed = [key for key in {**kept, **came} if kept.get(key) != came.get(key)]
    if changed:
        raise ValueError(
            f"{out} was begun with other arguments: "
            + "; ".join(f"{key} {kept.get(key)} then, {came.get(key)} now" for key in changed)
        )
    return Path(out)


def to_jsonable(value: object) -> Any:
    """The same in dicts, lists, strings and numbers.

    A dataclass becomes a dict of its fields; arrays and tensors nested lists; a path, device or dtype its
    text; a function or class of a module `module:name`; a number that JSON lacks "nan", "inf" or "-inf".

    Raises:
        TypeError: for anything else, so that no recipe is kept that cannot be built again.
    """
    if isinstance(value, Enum):
        return to_jsonable(value.value)
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return float(value) if isfinite(value) else str(float(value))
    if isinstance(value, np.ndarray | np.generic):
        return to_jsonable(value.tolist())
    if isinstance(value, torch.Tensor):
        return to_jsonable(value.detach().cpu().tolist())
    if isinstance(value, Path | torch.device | torch.dtype):
        return str(value)
    if "<" not in (name := getattr(value, "__qualname__", "<none>")):
        return f"{getattr(value, '__module__', None)}:{name}"
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: to_jsonable(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {str(to_jsonable(key)): to_jsonable(entry) for key, entry in value.items()}
    if isinstance(value, Set):
        return sorted((to_jsonable(entry) for entry in value), key=str)
    if isinstance(value, list | tuple | range):
        return [to_jsonable(entry) for entry in value]
    raise TypeError(f"a {type(value).__name__} cannot be kept in {FILE_NAME}: {value!r}")


def versions() -> dict[str, str | None]:
    """The versions of Python and of `PACKAGES`; None for what is not installed."""
    found: dict[str, str | None] = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = None
    return found


def git_state() -> dict[str, str | bool] | None:
    """The commit of the directory where we stand, and whether a tracked file differs from it; or None."""
    commit = _git("rev-parse", "HEAD")
    changes = _git("status", "--porcelain", "--untracked-files=no")
    if commit is None or changes is None:
        return None
    return {"commit": commit, "dirty": changes != ""}


def _git(*arguments: str) -> str | None:
    """What git says; None where there is no git, no checkout or no commit."""
    try:
        done = subprocess.run(["git", *arguments], capture_output=True, text=True, check=True, timeout=10)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def _new_directory(name: str, started: datetime) -> Path:
    """runs/<name>-<time>, with -2, -3 and so on behind it when runs start in the same second."""
    stem = f"{name}-{started:%Y%m%d-%H%M%S}"
    for nth in count(1):
        directory = Path("runs") / (stem if nth == 1 else f"{stem}-{nth}")
        try:
            directory.mkdir(parents=True)
        except FileExistsError:
            continue
        return directory
    raise AssertionError("count never ends")


def _empty_directory(directory: Path) -> Path:
    directory.mkdir(parents=True, exist_ok=True)
    if any(directory.iterdir()):
        raise FileExistsError(f"{directory} is not empty; a run takes a new or empty directory")
    return directory
