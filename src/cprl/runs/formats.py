"""The formats of the files of runs and studies: one number each, which grows when an older cprl could not
read what a newer one writes.

docs/experiments.md ("Versions of files") says which file has which.
"""

from collections.abc import Mapping
from importlib.metadata import version
from typing import Any, Final

from cprl.checks import shown

RECIPE: Final = 2
"""Of `recipe.json`, and of the journal and `report.json` beside it."""
MANIFEST: Final = 1
"""Of `manifest.json`, and of what it lists: weights, tables, transforms, decisions."""
TRAINING_STATE: Final = 2
"""Of checkpoints."""
STUDY: Final = 1
"""Of `study.json`."""
STUDY_TABLE: Final = 1
"""Of the table of a study."""


def written_by_another(recipe: object) -> str:
    """The end of a message about a recipe that cannot be read: which cprl wrote it, where that was another
    than this; else nothing."""
    versions = recipe.get("versions") if isinstance(recipe, Mapping) else None
    wrote = versions.get("cprl") if isinstance(versions, Mapping) else None
    here = version("cprl")
    return f"; cprl {shown(wrote)} wrote it, and this is {here}" if wrote not in (None, here) else ""


def refuse_newer(what: object, table: Mapping[str, Any], newest: int) -> None:
    """Refuses what a newer cprl wrote; any other format is left to the reader.

    Args:
        what: the file, or what it holds, for the message.
        table: its content, with the number as "format".
        newest: the highest format that this version reads.

    Raises:
        ValueError: names file, format and version, and says what to do.
    """
    found = table.get("format")
    if isinstance(found, int) and not isinstance(found, bool) and found > newest:
        raise ValueError(
            f"{what} has the format {shown(found)}, and cprl {version('cprl')} reads up to {newest}: a newer "
            "cprl wrote it; upgrade cprl"
        )
