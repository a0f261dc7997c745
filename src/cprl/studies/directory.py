"""A study's directory: what the study is, its runs, and how far its trials are."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from cprl.arguments import path, texts
from cprl.runs.directory import FILE_NAME as RECIPE
from cprl.runs.files import read_json, write_json
from cprl.studies.study import Study

FILE_NAME: Final = "study.json"
RUNS, STATUS = "runs", "status"
"""Folders of a study's directory."""


def directory_of(study: Study, out: Path | str | None) -> Path:
    """The directory of a study, by default `studies/<name>`.

    Raises:
        ValueError: for a file, and for the directory of a run.
    """
    found = Path("studies") / study.name if out is None else path("out", out)
    allowed = "a new directory, or that of an earlier study"
    if found.exists() and not found.is_dir():
        raise ValueError(f"out is {found}, a file; allowed: {allowed}")
    if (found / RECIPE).exists():
        raise ValueError(f"out is {found}, the directory of a run; allowed: {allowed}")
    return found


def write_study(study: Study, out: Path) -> None:
    """Writes what a study is into its directory."""
    write_json(out / FILE_NAME, study.to_config(out))


def read_study(out: Path | str, *, allow: Sequence[str] = ()) -> Study:
    """The study of a directory.

    Args:
        out: the directory.
        allow: the user's own code, "module:Class", that it may import.

    Raises:
        ValueError: where there is none, and for what is not allowed.
    """
    out = path("out", out)
    texts("allow", allow)
    try:
        table = read_json(out / FILE_NAME)
    except (OSError, ValueError) as error:
        raise ValueError(f"{out / FILE_NAME} is not the file of a study: {error!r}") from error
    return Study.from_config(table, allow=allow, directory=out)
