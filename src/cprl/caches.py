"""cache_folder: where compiled code is kept between runs."""

import os
from pathlib import Path


def cache_folder() -> Path:
    """$CPRL_CACHE, or the folder cprl in the user's cache folder."""
    if "CPRL_CACHE" in os.environ:
        return Path(os.environ["CPRL_CACHE"])
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "cprl"
