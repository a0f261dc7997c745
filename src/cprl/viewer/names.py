"""The names of a run's recordings: their files, and the id that joins them."""

import itertools
import json
import uuid
from pathlib import Path
from typing import Final

from cprl.runs.directory import FILE_NAME as RECIPE_FILE
from cprl.runs.files import read_json

FILE_NAME: Final = "run.rrd"


def free_name(run: Path) -> str:
    """run.rrd, or run-2.rrd and so on if the run has a recording already."""
    names = (FILE_NAME if nth == 1 else f"run-{nth}.rrd" for nth in itertools.count(1))
    return next(name for name in names if not (run / name).exists())


def recording_id(run: Path, file_name: str) -> str | None:
    """The recording id, the same when a run is resumed or extended; None where there is no run."""
    if not (run / RECIPE_FILE).exists():
        return None
    recipe = read_json(run / RECIPE_FILE)
    same = {name: own for name, own in recipe.items() if name not in ("experiment", "extended")}
    return str(uuid.uuid5(uuid.NAMESPACE_URL, file_name + json.dumps(same, sort_keys=True)))
