"""Names this machine's folder for data that can be recomputed: compiled loops, arrays of models, durations."""

import os
from pathlib import Path

CACHE = "EIGENHEAD_CACHE"


def cache_folder() -> Path:
    """Returns EIGENHEAD_CACHE, else $XDG_CACHE_HOME/eigenhead, else ~/.cache/eigenhead. The folder may not exist
    yet."""
    configured = os.environ.get(CACHE)
    if configured:
        return Path(configured)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "eigenhead"
