"""Names the folder in which this machine keeps what can be computed again: compiled loops, arrays of models,
durations."""

import os
from pathlib import Path

CACHE = "EIGENHEAD_CACHE"


def cache_folder() -> Path:
    """Returns EIGENHEAD_CACHE, else $XDG_CACHE_HOME/eigenhead, else ~/.cache/eigenhead. It need not exist."""
    configured = os.environ.get(CACHE)
    if configured:
        return Path(configured)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "eigenhead"
