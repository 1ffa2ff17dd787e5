"""Where the recordings, captures and models that stand beside the repository are; tests skip visibly without them."""

from pathlib import Path

import pytest

SHARED = Path(__file__).resolve().parents[2].parent / "shared"


def shared(relative: str) -> Path:
    """The path below the shared folder, or a visible skip where it is absent."""
    path = SHARED / relative
    if not path.exists():
        pytest.skip(f"shared data not beside the repository: {relative}")
    return path
