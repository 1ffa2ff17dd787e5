"""The uv that set this environment up."""

import os
import shutil
from pathlib import Path


def uv() -> Path:
    """Its path; deploy/setup.sh looks in the same places."""
    kept = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "eigenhead" / "uv"
    return Path(shutil.which("uv") or kept)
