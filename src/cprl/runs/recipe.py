"""The directory of a run and its `recipe.json`: experiment, versions, start time, git commit and
processor."""

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

from cprl.runs.files import (
    LOCK_FILE,
    RECIPE_FILE as RECIPE_FILE,
    RECIPE_FORMAT,
    RunLock,
    digest_of,
    read_json,
    refuse_newer,
    write_json,
)
from cprl.runs.length import Length, without_length
from cprl.system.output import ERR, console, quote_command
from cprl.system.process import cpu
from cprl.system.shipped import PROGRAM, cprl_command, typed_command_line
from cprl.values import (
    METRIC_WORDS,
    custom_targets,
    describe_changes,
    describe_customs,
    live_targets,
    refusal,
    refuse_live,
    short_repr,
    source_of,
)

_RESUME_FLAGS: Final = ("--resume", "--no-resume", "--take-over", "--no-take-over")
_DIRECTORY_FLAGS: Final = ("--out", "--runs")
_MOST_NAMED: Final = 5
"""The largest number of differences between two recipes that an error names."""

RECORDED_PACKAGES: Final = ("cprl", "torch", "torchrl", "tensordict", "numpy", "numba", "rerun-sdk")
"""The packages whose versions are recorded."""


_CURRENT_COMMAND: Final[ContextVar[Sequence[str] | None]] = ContextVar("command", default=None)


@contextmanager
def started_by(command: Sequence[str]) -> Iterator[None]:
    """Record a command line, script first, for the runs that begin or are resumed in the block."""
    token = _CURRENT_COMMAND.set(command)
    try:
        yield
    finally:
        _CURRENT_COMMAND.reset(token)


def start_run(
    out: Path | None,
    name: str,
    to_recipe: Callable[[Path], Mapping[str, Any]],
) -> Path:
    """Make the directory of a run and write its recipe: the experiment, versions, the git commit of the code
    of cprl, the type of processor, the time, and the command line of `started_by`, or else of this process,
    without local directories.

    Args:
        out: the directory, new or empty; None for `runs/<name>-<YYYYmmdd-HHMMSS>` in the working directory.
        to_recipe: returns the recipe for a directory, e.g. `cprl.Experiment.to_recipe`.

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
                **_code_by_checksum(recipe),
                "started": started.isoformat(timespec="seconds"),
                "command": _published_command(_CURRENT_COMMAND.get() or sys.argv),
            }
            write_json(directory / RECIPE_FILE, recipe)
    except BaseException:
        if is_new:
            with suppress(OSError):  # fails if another process has begun a run there
                directory.rmdir()
        raise
    return directory


def _new_directory(name: str, started: datetime) -> Path:
    """Make `runs/<name>-<time>`, with the suffix -2, -3 and so on for runs that start in the same second."""
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


def refuse_another_run(out: Path | None, to_recipe: Callable[[Path], Mapping[str, Any]], kind: Any) -> Length:
    """Refuse to resume a run with another recipe than it began with; only its length may grow, and `on_nan`
    change.

    Args:
        kind: the dataclass in the recipe, `cprl.Experiment`; fields that an earlier version lacked may then
            have their defaults.

    Returns:
        The length of the run so far, which is below that of the recipe if the run is to be extended.
    """
    if out is None:
        raise ValueError("resume requires the directory of the run as out")
    before = recipe_config(read_recipe(out))
    now = to_recipe(out)["experiment"]
    refuse_live(before, only_foreign=True, where=str(out))
    free = {**without_length({}), "on_nan": ""}
    differ = describe_changes({**before, **free}, {**now, **free}, "experiment", kind)
    if differ:
        more = f"; and {len(differ) - _MOST_NAMED} more" if len(differ) > _MOST_NAMED else ""
        raise ValueError(f"{out} was started with another recipe: {'; '.join(differ[:_MOST_NAMED])}{more}")
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

    Raises:
        ValueError: if there is none, or if it is no recipe that this cprl can read.
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
    METRIC_WORDS.update(recipe.get("metrics", {}))
    return recipe


def _refuse_odd_parts(recipe: Mapping[str, Any], path: Path) -> None:
    """Refuse a recipe with malformed parts about the processes that wrote the run."""
    for name in ("extended", "resumed"):
        parts = recipe.get(name, [])
        if not isinstance(parts, list) or not all(isinstance(part, Mapping) for part in parts):
            raise ValueError(f"{path}: {name} is {short_repr(parts)}; allowed: a list of tables")
    for part in recipe_parts(recipe):
        for name in ("versions", "code", "code_text", "frozen"):
            if not isinstance(part.get(name) or {}, Mapping):
                raise ValueError(f"{path}: {name} is {short_repr(part[name])}; allowed: a table")
    metrics = recipe.get("metrics", {})
    tables = list(metrics.values()) if isinstance(metrics, Mapping) else [None]
    if not all(isinstance(table, Mapping) and set(map(type, table.values())) <= {str} for table in tables):
        raise ValueError(f"{path}: metrics is {short_repr(metrics)}; allowed: tables of texts by name")


def recipe_parts(recipe: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the part of a recipe about each process that wrote the run: the first, those before an
    extension, and those that resumed it."""
    return [recipe, *recipe.get("extended", ()), *recipe.get("resumed", ())]


def recipe_config(recipe: Mapping[str, Any], *, where: object = "the recipe") -> dict[str, Any]:
    """Return the experiment of a recipe, as `Experiment.to_config` gives it.

    Args:
        where: the name of the recipe in messages.

    Raises:
        ValueError: for a table of another format, or without an experiment.
    """
    refuse_newer(where, recipe, RECIPE_FORMAT)
    if recipe.get("format") != RECIPE_FORMAT or not isinstance(recipe.get("experiment"), Mapping):
        raise ValueError(
            f"{where} is not the recipe of a run: it has the format {short_repr(recipe.get('format'))}; "
            f'allowed: {RECIPE_FORMAT}, with a table "experiment"'
        )
    return dict(recipe["experiment"])


STORED_RUN: Final = re.compile(r"agents\.(\*|\d+)\.((start_from\.|runs\.\d+\.)?run|stored)")
"""The path of a study's factor that is a run."""
_RUN_FIELDS: Final = {"Frozen": {"run"}, "Language": {"stored"}}
"""The fields that hold the path of a run, by kind."""


def with_runs_moved(table: Any, start: str | Path, end: str | Path, *, is_run: bool = False) -> Any:
    """Return a table, of an experiment or of values by path, in which the runs of its agents are relative to
    `end` instead of `start`. An argument "run" of user code stays."""
    if isinstance(table, str) and is_run and not os.path.isabs(table):
        return os.path.relpath(os.path.join(start, table), end)
    if isinstance(table, list):
        return [with_runs_moved(entry, start, end, is_run=is_run) for entry in table]
    if not isinstance(table, Mapping) or table.get("kind") == "Custom":
        return table
    names = {name for name in table if is_run or STORED_RUN.fullmatch(name)}
    names |= _RUN_FIELDS.get(str(table.get("kind")), set())
    return {name: with_runs_moved(entry, start, end, is_run=name in names) for name, entry in table.items()}


def runs_in(paths: Iterable[Path | str]) -> list[Path]:
    """Return the runs among paths, in order: each is a run's directory, or one that holds runs.

    Raises:
        ValueError: for a path without runs, a run that is there twice, and without any path.
    """
    runs: list[Path] = []
    for folder in map(Path, paths):
        is_run = (folder / RECIPE_FILE).exists()
        inside = [folder] if is_run else sorted(recipe.parent for recipe in folder.glob(f"*/{RECIPE_FILE}"))
        if not inside:
            raise ValueError(f"{folder} is no run; allowed: directories of runs, or one that holds some")
        runs += inside
    if not runs:
        raise refusal("runs", paths, "at least one directory of a run")
    resolved = [run.resolve() for run in runs]
    for run, path in zip(runs, resolved, strict=True):
        if resolved.count(path) > 1:
            raise ValueError(f"{run} is there twice; allowed: each run once")
    return runs


def write_length(run: Path, before: Length, length: Length) -> None:
    """Record in a run's recipe that it is extended from a length to another, and by which versions."""
    recipe = read_recipe(run)
    earlier = {before.unit: before.number, **_circumstances(recipe)}
    recipe["experiment"][length.unit] = length.number
    recipe |= {**_code_by_checksum(recipe), "extended": [*recipe.get("extended", []), earlier]}
    write_json(run / RECIPE_FILE, recipe)


def write_on_nan(run: Path, on_nan: str) -> None:
    """Record in a run's recipe a new value of `on_nan`."""
    recipe = read_recipe(run)
    if recipe["experiment"].get("on_nan") != on_nan:
        recipe["experiment"]["on_nan"] = on_nan
        write_json(run / RECIPE_FILE, recipe)


def write_metrics(run: Path, words: Mapping[str, Mapping[str, str]]) -> None:
    """Record the "title" and "unit" of custom metrics by name in a run's recipe."""
    recipe = read_recipe(run)
    if recipe.get("metrics", {}) != words:
        write_json(run / RECIPE_FILE, {**recipe, "metrics": words})
    METRIC_WORDS.update(words)


def write_circumstances(run: Path) -> list[str]:
    """Record versions, git commit, processor and user code in a run's recipe, if they differ from its last
    process.

    Returns:
        The changes since the run was started, a sentence each; with any, its numbers may differ from those of
        an uninterrupted run.
    """
    recipe = read_recipe(run)
    now = _circumstances(recipe)
    before = {name: recipe[name] for name in now if recipe.get(name) is not None}
    last = (recipe.get("resumed") or [recipe])[-1]
    if any(last.get(name) != now[name] for name in now):
        recipe |= {**_code_by_checksum(recipe), "resumed": [*recipe.get("resumed", []), now]}
        write_json(run / RECIPE_FILE, recipe)
    changes = []
    for name, value in before.items():
        changes += describe_changes(value, now[name], name)
    return changes


def warn_of_changes(run: Path, changes: Sequence[str]) -> None:
    """Warn on standard error if a run is used under other circumstances than it was started under."""
    if changes:
        console(ERR).print(
            f"Warning: {run} was begun under other versions or other code, so its numbers may differ from "
            f"an uninterrupted run: {'; '.join(changes)}",
            soft_wrap=True,
            markup=False,
        )


def changed_code(recipe: Mapping[str, Any]) -> list[str]:
    """Return the modules of user code whose source has changed since a run, or a part of it, began.

    Modules without a checksum in the recipe, and modules that no longer exist, count as unchanged.
    """
    now = _code_checksums(recipe)
    before = [item for part in recipe_parts(recipe) for item in (part.get("code") or {}).items()]
    return sorted({module for module, digest in before if now.get(module, digest) != digest})


def _circumstances(recipe: Mapping[str, Any]) -> dict[str, Any]:
    code = _code_checksums(recipe)
    return {"versions": versions(), "git": git_state(), "cpu": cpu(), **({"code": code} if code else {})}


def _code_checksums(recipe: Mapping[str, Any]) -> dict[str, str]:
    return {module: digest_of(text) for module, text in _sources(recipe).items()}


def _code_by_checksum(recipe: Mapping[str, Any]) -> dict[str, dict[str, str]]:
    """Return the sources of user code by checksum for a recipe, with those that it has already."""
    texts = {digest_of(text): text for text in _sources(recipe).values()}
    return {"code_text": {**(recipe.get("code_text") or {}), **texts}} if texts else {}


def _sources(recipe: Mapping[str, Any]) -> dict[str, str]:
    """Return the source of each module that a `Custom` of a recipe names, except packages with a recorded
    version."""
    table = recipe.get("experiment")
    modules = {target.partition(":")[0] for target in (*custom_targets(table), *live_targets(table))}
    texts = {
        name: source_of(name) for name in sorted(modules) if name.partition(".")[0] not in RECORDED_PACKAGES
    }
    return {module: text for module, text in texts.items() if text is not None}


def versions() -> dict[str, str | None]:
    """Return the versions of Python and of `RECORDED_PACKAGES`; None for packages that are not installed."""
    numbers: dict[str, str | None] = dict.fromkeys(("python", *RECORDED_PACKAGES))
    numbers["python"] = platform.python_version()
    for package in RECORDED_PACKAGES:
        with suppress(PackageNotFoundError):
            numbers[package] = version(package)
    return numbers


def resume_command(run: Path) -> str:
    """Return the command line that resumes a run, which is that of `started_by` with other flags.

    A run that Python started without one is resumed by `cprl run`; a run with live code only by this process.
    """
    command = _CURRENT_COMMAND.get()
    directory = f"./{run}" if str(run).startswith("-") else str(run)  # so that it is not read as a flag
    path = run / RECIPE_FILE
    table = read_json(path).get("experiment") if path.exists() else None
    live = ", ".join(live_targets(table))
    if live:
        again = f"cprl.run(..., {str(run)!r}, resume=True)"
        return f"{again} in this process; no other can, as it alone has {live}"
    if command is None:
        allow = [word for target in custom_targets(table) for word in ("--allow", target)]
        return quote_command([*cprl_command(), "run", directory, "--resume", *allow])
    words = without_options(command, _DIRECTORY_FLAGS)
    words = typed_command_line([word for word in words if word.replace("_", "-") not in _RESUME_FLAGS])
    return quote_command([*words, "--out", directory, "--resume"])


def _published_command(words: Sequence[str]) -> str:
    """Return a command line without local directories, because recipes are published: without `--out` and
    `--runs`, and the script relative to the working directory, or by its name."""
    first = words[0].split(" ") if words[0].startswith(PROGRAM) else [without_directories(words[0])]
    return shlex.join([*first, *without_options(words[1:], _DIRECTORY_FLAGS)])


def without_directories(program: str) -> str:
    """Return the first word of a command line for publication: relative to the working directory, or by its
    name."""
    path = Path(program)
    here = Path.cwd()
    if path.is_absolute():
        path = path.relative_to(here) if path.is_relative_to(here) else Path(path.name)
    return str(path)


def without_options(words: Sequence[str], options: Sequence[str]) -> list[str]:
    """Return the words of a command line without some options, such as "--out", and their values."""
    rest = iter(words)
    others = []
    for word in rest:
        if word in options:
            next(rest, None)
        elif not word.startswith(tuple(f"{option}=" for option in options)):
            others.append(word)
    return others


BUILT_FROM: Final = "commit.json"
"""The file of a wheel's package with the commit that it was built from; `hatch_build.py` writes it."""

_PACKAGE: Final = Path(__file__).parents[1]
_GIT_VARIABLES: Final = ("GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE")
"""Variables that lead git to another checkout, e.g. in a hook."""


def git_state(package: Path = _PACKAGE) -> dict[str, str | bool] | None:
    """Return the commit of cprl's code, and whether tracked files have changed since, as {"commit": 40
    hexadecimal digits, "dirty": bool}; None if no commit is known, e.g. for a wheel that was built outside a
    checkout."""
    written = package / BUILT_FROM
    if written.is_file():
        commit = read_json(written)
        return {"commit": str(commit["commit"]), "dirty": bool(commit["dirty"])}
    if _run_git(package, "ls-files", "--error-unmatch", "__init__.py") is None:
        return None
    state = _run_git(package, "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*")
    if state is None:
        return None
    return {"commit": state.removesuffix("-dirty"), "dirty": state.endswith("-dirty")}


def _run_git(folder: Path, *arguments: str) -> str | None:
    environment = {name: value for name, value in os.environ.items() if name not in _GIT_VARIABLES}
    words = ["git", "-C", str(folder), *arguments]
    try:
        done = subprocess.run(words, capture_output=True, text=True, check=True, timeout=10, env=environment)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def custom_rules_in(table: Mapping[str, Any]) -> str:
    """Return a description of the custom rules in a stored experiment; "" without any."""
    return "; ".join(describe_customs([table.get("game"), table.get("transforms")]))


_LONGEST_VALUE: Final = 90
"""The longest text of a value in the recipe's table, in characters; recipe.json has the whole text."""


def recipe_table(recipe: Mapping[Any, Any]) -> str:
    """Return a recipe as a Markdown table with one row per value, such as `| rules.beam_length_cells | 10 |`.

    Texts of several lines, such as drawn boards, follow below the table. An entry of a list that equals the
    first entry is one row that refers to the first.
    """
    rows = []
    long_texts = []
    for path, value in _values_by_path(recipe, ""):
        if isinstance(value, str) and "\n" in value:
            long_texts.append(f"`{path}`\n\n```\n{value}\n```")
            continue
        text = value if isinstance(value, str) else short_repr(value)
        if len(text) > _LONGEST_VALUE:
            text = f"{text[:_LONGEST_VALUE]} ..."
        rows.append(f"| {_table_cell(path)} | {_table_cell(text)} |")
    return "\n\n".join(["\n".join(["| place | value |", "| --- | --- |", *rows]), *long_texts])


def _values_by_path(value: Any, path: str) -> Iterator[tuple[str, Any]]:
    """Yield each value that holds no other values, with its dotted path: {"a": {"b": 1}} yields "a.b", 1."""
    if isinstance(value, Mapping) and value:
        for name, entry in value.items():
            yield from _values_by_path(entry, f"{path}.{name}".removeprefix("."))
    elif isinstance(value, list | tuple) and any(isinstance(entry, Mapping) for entry in value):
        for index, entry in enumerate(value):
            if index and entry == value[0]:
                yield f"{path}.{index}", f"as {path}.0"
            else:
                yield from _values_by_path(entry, f"{path}.{index}")
    else:
        yield path, value


def _table_cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")
