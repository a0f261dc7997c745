"""The directory of a run; its `recipe.json` holds the experiment, versions, start time, git commit and
the type of processor."""

import os
import platform
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version
from itertools import count
from pathlib import Path
from typing import Any, Final

from cprl.runs.files import LOCK_FILE, RECIPE_FORMAT, RunLock, digest_of, read_json, refuse_newer, write_json
from cprl.runs.files import RECIPE_FILE as RECIPE_FILE
from cprl.runs.length import Length, without_length
from cprl.system.output import ERR, console, printed
from cprl.system.process import cpu
from cprl.system.shipped import PROGRAM, command_of, cprl_here
from cprl.values import (
    OWN_METRICS,
    custom_targets,
    described,
    differences,
    live_targets,
    refusal,
    refuse_live,
    shown,
    source_of,
    without_departed,
)

_RESUMES: Final = ("--resume", "--no-resume", "--take-over", "--no-take-over")
_DIRECTORIES: Final = ("--out", "--runs")
_NAMED: Final = 5
"""The largest number of differences between two recipes that an error names."""

PACKAGES: Final = ("cprl", "torch", "torchrl", "tensordict", "numpy", "numba", "rerun-sdk")
"""The packages whose versions are recorded."""


_COMMAND: Final[ContextVar[Sequence[str] | None]] = ContextVar("command", default=None)


@contextmanager
def started_by(command: Sequence[str]) -> Iterator[None]:
    """Within the block runs begin, and are resumed, by a command line, script first."""
    token = _COMMAND.set(command)
    try:
        yield
    finally:
        _COMMAND.reset(token)


def start_run(
    out: Path | None,
    name: str,
    to_recipe: Callable[[Path], Mapping[str, Any]],
    *,
    command: Sequence[str] | None = None,
) -> Path:
    """Make the directory of a run and write its recipe: the experiment, versions, the git commit of the code
    of cprl, the type of processor, the time, and the command without local directories.

    Args:
        out: the directory, new or empty; None for `runs/<name>-<YYYYmmdd-HHMMSS>` in the working directory.
        to_recipe: makes the recipe for a directory, e.g. `cprl.Experiment.to_recipe`.
        command: the command line, script first; by default that of `started_by`, or of this process.

    Raises:
        FileExistsError: if `out` is not empty.
        RunLockedError: if another process is just starting a run there.
    """
    if Path(name).name != name or "\0" in name:
        raise refusal("name", name, "the name of a directory, without slashes")
    started = datetime.now().astimezone()
    is_new = out is None or not Path(out).exists()
    directory = _new_directory(name, started) if out is None else Path(out)
    if not is_new:
        _refuse_contents(directory)
    directory.mkdir(parents=True, exist_ok=True)
    try:
        with RunLock(directory):
            _refuse_contents(directory)
            recipe = to_recipe(directory)
            recipe = {
                **recipe,
                **_circumstances(recipe),
                **_code_text(recipe),
                "started": started.isoformat(timespec="seconds"),
                "command": _command(command or _COMMAND.get() or sys.argv),
            }
            write_json(directory / RECIPE_FILE, recipe)
    except BaseException:
        if is_new:
            with suppress(OSError):  # not where another process has begun a run there
                directory.rmdir()
        raise
    return directory


def _new_directory(name: str, started: datetime) -> Path:
    """runs/<name>-<time>, with the suffix -2, -3 and so on for runs that start in the same second."""
    for number in count(1):
        suffix = "" if number == 1 else f"-{number}"
        directory = Path("runs", f"{name}-{started:%Y%m%d-%H%M%S}{suffix}")
        with suppress(FileExistsError):
            directory.mkdir(parents=True)
            return directory
    raise AssertionError("count never ends")


def _refuse_contents(directory: Path) -> None:
    if any(path.name != LOCK_FILE for path in directory.iterdir()):
        raise FileExistsError(f"{directory} is not empty; allowed: a new or empty directory")


def refuse_another_run(
    out: Path | None, to_recipe: Callable[[Path], Mapping[str, Any]], kind: Any = None
) -> Length:
    """Refuse to resume what was not begun with the same recipe; only its number of episodes, or of steps, may
    grow, and `on_nan` be another.

    Args:
        kind: the dataclass of what the recipe holds, `cprl.Experiment`; fields that an earlier version did
            not know are then no differences while they have their defaults.

    Returns:
        The length of the run so far, below that of the recipe if it is to be extended.
    """
    if out is None:
        raise ValueError("resume requires the directory of the run as out")
    before, now = recipe_config(read_recipe(out)), to_recipe(out)["experiment"]
    refuse_live(before, of_others=True, where=str(out))
    free = {**without_length({}), "on_nan": ""}
    differ = differences({**before, **free}, {**now, **free}, "experiment", kind)
    if differ:
        more = f"; and {len(differ) - _NAMED} more" if len(differ) > _NAMED else ""
        raise ValueError(f"{out} was started with another recipe: {'; '.join(differ[:_NAMED])}{more}")
    length = Length.of(before)
    length_now = Length.of(now)
    if length != length_now and not length.is_shorter_than(length_now):
        raise ValueError(
            f"{out} has {length}, which cannot become {length_now}; allowed: as many, or more to extend it"
        )
    return length


def read_recipe(run: Path) -> dict[str, Any]:
    """Read the recipe that `start_run` wrote.

    Args:
        run: its directory, or the file itself.
    """
    path = Path(run) if Path(run).is_file() else Path(run) / RECIPE_FILE
    try:
        recipe = read_json(path)
    except FileNotFoundError as error:
        reason = f"it holds no {RECIPE_FILE}" if Path(run).is_dir() else "there is no such directory"
        raise ValueError(f"{run} is not the directory of a run: {reason}") from error
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} is not the recipe of a run: {error!r}") from error
    recipe_config(recipe, where=path)
    _refuse_odd_parts(recipe, path)
    OWN_METRICS.update(recipe.get("metrics", {}))
    return recipe


def _refuse_odd_parts(recipe: Mapping[str, Any], path: Path) -> None:
    """Refuse a recipe that says something else than tables of the processes that wrote the run."""
    for name in ("extended", "resumed"):
        parts = recipe.get(name, [])
        if not isinstance(parts, list) or not all(isinstance(part, Mapping) for part in parts):
            raise ValueError(f"{path}: {name} is {shown(parts)}; allowed: a list of tables")
    for part in parts_of(recipe):
        for name in ("versions", "code", "code_text", "frozen"):
            if not isinstance(part.get(name) or {}, Mapping):
                raise ValueError(f"{path}: {name} is {shown(part[name])}; allowed: a table")
    metrics = recipe.get("metrics", {})
    tables = list(metrics.values()) if isinstance(metrics, Mapping) else [None]
    if not all(isinstance(table, Mapping) and set(map(type, table.values())) <= {str} for table in tables):
        raise ValueError(f"{path}: metrics is {shown(metrics)}; allowed: tables of texts by name")


def parts_of(recipe: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return what a recipe says of each process that wrote the run: of the first, of those before it was
    extended, and of those that resumed it."""
    return [recipe, *recipe.get("extended", ()), *recipe.get("resumed", ())]


def recipe_config(recipe: Mapping[str, Any], *, where: object = "the recipe") -> dict[str, Any]:
    """The experiment of a recipe, as `Experiment.to_config` gives it.

    Args:
        where: what the recipe is called in messages.
    """
    refuse_newer(where, recipe, RECIPE_FORMAT)
    if recipe.get("format") != RECIPE_FORMAT or not isinstance(recipe.get("experiment"), Mapping):
        raise ValueError(
            f"{where} is not the recipe of a run: it has the format {shown(recipe.get('format'))}; allowed: "
            f'{RECIPE_FORMAT}, with a table "experiment"'
        )
    return stored_experiment(recipe["experiment"])


BEFORE_AUTO: Final = {"engine": "compiled"}
"""What an experiment means that was stored before it said how updates are computed."""


def stored_experiment(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return the table of an experiment, as any version stored it, as `Experiment.to_config` gives it now."""
    return {**BEFORE_AUTO, **without_departed(table)}


STORED_RUN: Final = re.compile(r"agents\.(\*|\d+)(\.start_from)?\.run")
"""A path, as studies have it, that names the run of a `Frozen` agent."""


def with_runs_moved(table: Any, start: str | Path, end: str | Path, *, is_run: bool = False) -> Any:
    """Return a table, of an experiment or of values by path, in which the runs of `Frozen` agents, relative
    to `start`, are relative to `end`; an argument of the user's own that is called "run" stays."""
    if isinstance(table, str) and is_run and not os.path.isabs(table):
        return os.path.relpath(os.path.join(start, table), end)
    if isinstance(table, list):
        return [with_runs_moved(entry, start, end, is_run=is_run) for entry in table]
    if not isinstance(table, Mapping) or table.get("kind") == "Custom":
        return table
    names = {name for name in table if is_run or STORED_RUN.fullmatch(name)}
    names |= {"run"} if table.get("kind") == "Frozen" else set()
    return {name: with_runs_moved(entry, start, end, is_run=name in names) for name, entry in table.items()}


def runs_in(paths: Iterable[Path | str]) -> list[Path]:
    """The runs among paths: each is a run's directory, or one that holds runs, in order."""
    runs: list[Path] = []
    for folder in map(Path, paths):
        is_run = (folder / RECIPE_FILE).exists()
        inside = [folder] if is_run else sorted(recipe.parent for recipe in folder.glob(f"*/{RECIPE_FILE}"))
        if not inside:
            raise ValueError(f"{folder} is no run; allowed: directories of runs, or one that holds some")
        runs += inside
    if not runs:
        raise refusal("runs", paths, "at least one directory of a run")
    places = [run.resolve() for run in runs]
    for run, place in zip(runs, places, strict=True):
        if places.count(place) > 1:
            raise ValueError(f"{run} is there twice; allowed: each run once")
    return runs


def write_length(run: Path, before: Length, length: Length) -> None:
    """Write into a run's recipe from which length to which it is extended, and by which versions."""
    recipe = read_recipe(run)
    earlier = {before.unit: before.number, **_circumstances(recipe)}
    recipe["experiment"][length.unit] = length.number
    recipe |= {**_code_text(recipe), "extended": [*recipe.get("extended", []), earlier]}
    write_json(run / RECIPE_FILE, recipe)


def write_on_nan(run: Path, on_nan: str) -> None:
    """Write into a run's recipe what now happens where a number is not finite."""
    recipe = read_recipe(run)
    if recipe["experiment"].get("on_nan") != on_nan:
        recipe["experiment"]["on_nan"] = on_nan
        write_json(run / RECIPE_FILE, recipe)


def write_metrics(run: Path, words: Mapping[str, Mapping[str, str]]) -> None:
    """Write into a run's recipe what metrics of the user's own are called: "title" and "unit" by name."""
    recipe = read_recipe(run)
    if recipe.get("metrics", {}) != words:
        write_json(run / RECIPE_FILE, {**recipe, "metrics": words})
    OWN_METRICS.update(words)


def write_circumstances(run: Path) -> list[str]:
    """Write into a run's recipe under which versions, git commit, processor and code of the user's own it is
    resumed, if they are not those of its last process.

    Returns:
        What differs now from when the run was started, a sentence for each, so that its numbers may differ
        from an uninterrupted run.
    """
    recipe = read_recipe(run)
    now = _circumstances(recipe)
    before = {name: recipe[name] for name in now if recipe.get(name) is not None}
    last = (recipe.get("resumed") or [recipe])[-1]
    changed = [line for name in before for line in differences(before[name], now[name], name)]
    if any(last.get(name) != now[name] for name in now):
        recipe |= {**_code_text(recipe), "resumed": [*recipe.get("resumed", []), now]}
        write_json(run / RECIPE_FILE, recipe)
    return changed


def say_changes(run: Path, changes: Sequence[str]) -> None:
    """Warn on standard error where a run is used under other circumstances than those it was made under."""
    if changes:
        console(ERR).print(
            f"Warning: {run} was begun under other versions or other code, so its numbers may differ from "
            f"an uninterrupted run: {'; '.join(changes)}",
            soft_wrap=True,
            markup=False,
        )


def changed_code(recipe: Mapping[str, Any]) -> list[str]:
    """Return the modules of the user's own that have another text now than when a run or a part of it began.

    Those of which the recipe has no checksum, and those that are gone, count as unchanged.
    """
    now = _code(recipe)
    before = [item for part in parts_of(recipe) for item in (part.get("code") or {}).items()]
    return sorted({module for module, digest in before if now.get(module, digest) != digest})


def _circumstances(recipe: Mapping[str, Any]) -> dict[str, Any]:
    code = _code(recipe)
    return {"versions": versions(), "git": git_state(), "cpu": cpu(), **({"code": code} if code else {})}


def _code(recipe: Mapping[str, Any]) -> dict[str, str]:
    return {module: digest_of(text) for module, text in _sources(recipe).items()}


def _code_text(recipe: Mapping[str, Any]) -> dict[str, dict[str, str]]:
    """What a recipe says of these texts: each by its checksum, with those of before."""
    texts = {digest_of(text): text for text in _sources(recipe).values()}
    return {"code_text": {**(recipe.get("code_text") or {}), **texts}} if texts else {}


def _sources(recipe: Mapping[str, Any]) -> dict[str, str]:
    """The text of each module that a `Custom` of a recipe names, without packages whose versions it has."""
    table = recipe.get("experiment")
    modules = {target.partition(":")[0] for target in (*custom_targets(table), *live_targets(table))}
    texts = {name: source_of(name) for name in sorted(modules) if name.partition(".")[0] not in PACKAGES}
    return {module: text for module, text in texts.items() if text is not None}


def versions() -> dict[str, str | None]:
    """Return the versions of Python and of `PACKAGES`; None for packages that are not installed."""
    numbers: dict[str, str | None] = dict.fromkeys(("python", *PACKAGES))
    numbers["python"] = platform.python_version()
    for package in PACKAGES:
        with suppress(PackageNotFoundError):
            numbers[package] = version(package)
    return numbers


def resume_command(run: Path, command: Sequence[str] | None = None) -> str:
    """Return the command line that resumes a run.

    Args:
        command: the command line that started or resumed it, script first; by default that of `started_by`.
            A run that was started from Python without one is resumed by `cprl run`; one with live code only
            by the process that has it.
    """
    command = command or _COMMAND.get()
    directory = f"./{run}" if str(run).startswith("-") else str(run)  # not to be read as a flag
    path = run / RECIPE_FILE
    table = read_json(path).get("experiment") if path.exists() else None
    if live := live_targets(table):
        has = ", ".join(live)
        return (
            f"cprl.run(..., {str(run)!r}, resume=True) in this process; no other can, as it alone has {has}"
        )
    if command is None:
        allow = [word for target in custom_targets(table) for word in ("--allow", target)]
        return printed([*cprl_here(), "run", directory, "--resume", *allow])
    words = without_options(command, _DIRECTORIES)
    words = command_of([word for word in words if word.replace("_", "-") not in _RESUMES])
    return printed([*words, "--out", directory, "--resume"])


def _command(words: Sequence[str]) -> str:
    """A command line without local directories, because recipes are published: the script relative to the
    working directory, or its name alone, no `--out` and no `--runs`."""
    first = words[0].split(" ") if words[0].startswith(PROGRAM) else [without_directories(words[0])]
    return shlex.join([*first, *without_options(words[1:], _DIRECTORIES)])


def without_directories(program: str) -> str:
    """The first word of a command line as recipes and summaries have it, which are published: relative to the
    working directory, or its name alone."""
    path, here = Path(program), Path.cwd()
    if path.is_absolute():
        path = path.relative_to(here) if path.is_relative_to(here) else Path(path.name)
    return str(path)


def without_options(words: Sequence[str], options: Sequence[str]) -> list[str]:
    """The words of a command line without some options, such as "--out", and the value of each."""
    rest, others = iter(words), []
    for word in rest:
        if word in options:
            next(rest, None)
        elif not word.startswith(tuple(f"{option}=" for option in options)):
            others.append(word)
    return others


BUILT_FROM: Final = "commit.json"
"""The file of the package that says from which commit a wheel was built; `hatch_build.py` writes it."""

_PACKAGE: Final = Path(__file__).parents[1]
_OF_ANOTHER: Final = ("GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE")
"""Variables that lead git to another checkout than that of the folder, as in a hook."""


def git_state(package: Path = _PACKAGE) -> dict[str, str | bool] | None:
    """Return the commit of the code of cprl, wherever this process stands, and whether a tracked file was
    changed since, as {"commit": 40 hexadecimal digits, "dirty": bool}; None where no commit is known: of a
    wheel that was built outside a checkout, or of files that git does not track."""
    written = package / BUILT_FROM
    if written.is_file():
        built = read_json(written)
        return {"commit": str(built["commit"]), "dirty": bool(built["dirty"])}
    if _git(package, "ls-files", "--error-unmatch", "__init__.py") is None:
        return None
    state = _git(package, "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*")
    if state is None:
        return None
    return {"commit": state.removesuffix("-dirty"), "dirty": state.endswith("-dirty")}


def _git(folder: Path, *arguments: str) -> str | None:
    environment = {name: value for name, value in os.environ.items() if name not in _OF_ANOTHER}
    words = ["git", "-C", str(folder), *arguments]
    try:
        done = subprocess.run(words, capture_output=True, text=True, check=True, timeout=10, env=environment)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


_OF_RULES: Final = ("game", "transforms")


def rules_of_own(table: Mapping[str, Any]) -> str:
    """Return the rules of the user's own in words, of an experiment as a recipe stores it; "" without any."""
    return "; ".join(described([table.get(name) for name in _OF_RULES]))
