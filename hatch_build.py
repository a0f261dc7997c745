"""Writes into a wheel, and into a source distribution, from which commit it is built, where git knows it.

`cprl.runs.recipe` reads it, since an installed wheel has no git. An editable installation asks git itself.
"""

import json
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

NAME = "commit.json"


class Commit(BuildHookInterface):
    """Adds `cprl/commit.json`; a wheel made of a source distribution takes the one that is in there."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Asks git, unless the checkout itself is what is installed."""
        self._folder = tempfile.TemporaryDirectory()
        if version == "editable" or self._git("ls-files", "--error-unmatch", "hatch_build.py") is None:
            return
        commit, changes = self._git("rev-parse", "HEAD"), self._git("status", "--porcelain", "-uno")
        if commit is None or changes is None:
            return
        written = Path(self._folder.name) / NAME
        written.write_text(json.dumps({"commit": commit, "dirty": changes != ""}) + "\n")
        place = "src/cprl" if self.target_name == "sdist" else "cprl"
        build_data["force_include"][str(written)] = f"{place}/{NAME}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Removes the temporary file."""
        self._folder.cleanup()

    def _git(self, *arguments: str) -> str | None:
        try:
            done = subprocess.run(
                ["git", "-C", self.root, *arguments], capture_output=True, text=True, check=True
            )
        except (OSError, subprocess.SubprocessError):
            return None
        return done.stdout.strip()
