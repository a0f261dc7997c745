"""From which commit the code of cprl is: that of its checkout, or the one from which its wheel was built."""

import os
import subprocess
from pathlib import Path
from typing import Final

from cprl.runs.files import read_json

BUILT_FROM: Final = "commit.json"
"""The file of the package that says from which commit a wheel was built; `hatch_build.py` writes it."""

_PACKAGE: Final = Path(__file__).parents[1]
_OF_ANOTHER: Final = ("GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE")
"""Variables that lead git to another checkout than that of the folder, as in a hook."""


def git_state(package: Path = _PACKAGE) -> dict[str, str | bool] | None:
    """The commit of the code of cprl, and whether a tracked file differed from it.

    Where this process stands does not count: the git folder of somebody's own project says nothing of cprl.

    Args:
        package: the folder of the package.

    Returns:
        {"commit": 40 hexadecimal digits, "dirty": whether a tracked file was changed}; None where no commit
        is known: of a wheel that was built outside a checkout, or of files that git does not track.
    """
    written = package / BUILT_FROM
    if written.is_file():
        built = read_json(written)
        return {"commit": str(built["commit"]), "dirty": bool(built["dirty"])}
    if _git(package, "ls-files", "--error-unmatch", "__init__.py") is None:
        return None
    commit = _git(package, "rev-parse", "HEAD")
    changes = _git(package, "status", "--porcelain", "--untracked-files=no")
    if commit is None or changes is None:
        return None
    return {"commit": commit, "dirty": changes != ""}


def _git(folder: Path, *arguments: str) -> str | None:
    """The output of git in a folder; None if there is no git, no checkout or no commit."""
    own = {name: value for name, value in os.environ.items() if name not in _OF_ANOTHER}
    words = ["git", "-C", str(folder), *arguments]
    try:
        done = subprocess.run(words, capture_output=True, text=True, check=True, timeout=10, env=own)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()
