"""Exports the results of a run, small enough to commit: its directory without recording and buffers."""

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from cprl.arguments import path as path_of
from cprl.runs.directory import read_recipe
from cprl.runs.episodes import FILE_NAME, read_episodes, read_table
from cprl.runs.manifest import refuse_missing, verify, write_listed
from cprl.runs.weights import DECISIONS, TRANSFORMS

_IF_ANY = tuple(f"checkpoints/{name}" for name in (TRANSFORMS, DECISIONS))
_WHOLE = ("recipe.json", "report.json", "checkpoints/final.pt")


def export_results(run: Path, folder: Path) -> Path:
    """Copies the files of a finished run that a report needs: recipe, episodes, evaluation, weights.

    Args:
        run: the run's directory.
        folder: the target; files of an earlier copy are replaced.

    Returns:
        The folder, which `cprl.load`, `read_episodes` and `cprl report` accept like the run itself. Metrics
        and returns are float32, and rows are sorted by replica, episode and agent.

    Raises:
        ValueError: if there is no run, or a file of it is damaged.
        FileNotFoundError: if the run has not ended, or lost a file since.
    """
    run, folder = path_of("run", run), path_of("folder", folder)
    read_recipe(run)
    for name in _WHOLE:
        if not (run / name).exists():
            raise FileNotFoundError(f"{run / name} does not exist: has the run ended?")
    refuse_missing(run)
    copied = [name for name in (*_WHOLE, *_IF_ANY) if (run / name).exists()]
    for name in copied:
        verify(run / name)
    folder.mkdir(parents=True, exist_ok=True)
    for name in copied:
        _copy(run / name, folder, name)
    _write(read_episodes(run), folder, FILE_NAME)
    for path in sorted((run / "evaluation").glob("*.parquet")):
        _write(read_table(path), folder, f"evaluation/{path.name}")
    return folder


def _copy(path: Path, folder: Path, name: str) -> None:
    content = path.read_bytes()
    write_listed(folder, name, lambda file: file.write(content))


def _write(table: pa.Table, folder: Path, name: str) -> None:
    ordered = table.sort_by([(name, "ascending") for name in ("replica", "episode", "agent")])
    kinds = pa.schema(
        [(own.name, pa.float32() if own.type == pa.float64() else own.type) for own in table.schema]
    ).with_metadata(table.schema.metadata)
    small = ordered.cast(kinds)
    write_listed(
        folder, name, lambda file: pq.write_table(small, file, compression="zstd", compression_level=19)
    )
