"""Which weights of other runs play in a run: those that did when it began, whatever becomes of those runs."""

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from cprl.runs.checkpoints import FOLDER
from cprl.runs.files import checksum

FIELD: Final = "frozen"
"""Of `recipe.json`: the checksum of the weights of each run whose agents play, by the path of that run."""


def partners_of(run: Path, partners: Iterable[str]) -> dict[str, dict[str, str]]:
    """What the recipe of a run says of which weights of other runs play in it; those that have not ended keep
    changing, and are left out.

    Args:
        run: the directory of the run that begins.
        partners: the directories of the others.
    """
    final = {own: Path(own) / FOLDER / "final.pt" for own in partners}
    found = {os.path.relpath(own, run): checksum(path) for own, path in final.items() if path.exists()}
    return {FIELD: found} if found else {}


def weights_of(recipe: Mapping[str, Any], run: Path, partner: str) -> str | None:
    """The name of the weights of another run that play in a run; None for the final ones it has now.

    Args:
        recipe: that of the run.
        run: its directory.
        partner: the directory of the other run.

    Raises:
        ValueError: if the other run no longer has the weights that played.
    """
    wanted = (recipe.get(FIELD) or {}).get(os.path.relpath(partner, run))
    if wanted is None:
        return None
    folder = Path(partner) / FOLDER
    for path in (folder / "final.pt", *sorted(folder.glob("final-*.pt"))):
        if path.exists() and checksum(path) == wanted:
            return path.stem
    raise ValueError(
        f"{partner} no longer has the weights that play in {run} (a file with the checksum {wanted} "
        f"in its {FOLDER}/); allowed: the run as it was, extended, or its export"
    )
