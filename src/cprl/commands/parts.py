"""What several commands do alike: runs by name, the files that they are to write, tables."""

from collections.abc import Callable, Sequence
from pathlib import Path

from rich.table import Table

from cprl.runs.directory import read_recipe
from cprl.runs.files import refuse_to_write_over
from cprl.system.output import OUT, console, say


def check_files(out: Path | None = None, figure: Path | None = None) -> None:
    """Checks what `--out` and `--figure` name before hours of work.

    Raises:
        FileExistsError: if a file exists.
        ValueError: if the name of the figure does not end in .png.
    """
    if out is not None:
        refuse_to_write_over(out)
    if figure is not None:
        from cprl.terminal.style import check_picture

        check_picture(figure, "--figure")


def check_runs(*runs: Path | str) -> None:
    """Checks that runs are there, before what plays their agents is imported, which takes seconds.

    Raises:
        ValueError: for a path that is no run.
    """
    for run in runs:
        read_recipe(Path(run))


def tell_files(out: Path | None, figure: Path | None, draw: Callable[[Path], Path]) -> None:
    """Says where the episodes are, and draws the figure."""
    if out is not None:
        say(f"Episodes: {out}")
    if figure is not None:
        say(f"Figure: {draw(figure)}")


def runs_by_name(words: Sequence[str]) -> list[str] | dict[str, str]:
    """Runs as `crossplay` takes them: paths, or a table where one has a name, NAME=PATH.

    Raises:
        ValueError: if two have one name.
    """
    pairs = [_name_and_path(word) for word in words]
    if not any(name for name, _ in pairs):
        return [path for _, path in pairs]
    named = [(name or Path(path).resolve().name, path) for name, path in pairs]
    names = [name for name, _ in named]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{name} names {names.count(name)} runs; allowed: each its own, NAME=PATH")
    return dict(named)


def _name_and_path(word: str) -> tuple[str, str]:
    """The parts of NAME=PATH; a path that is there may have "=" itself."""
    name, equals, path = word.partition("=")
    return (name, path) if equals and name and "/" not in name and not Path(word).exists() else ("", word)


def print_tables(*tables: Table) -> None:
    """Prints tables; into a file or pipe as wide as they are."""
    shown = console(width=None if OUT.isatty() else 250)
    for table in tables:
        shown.print(table)
