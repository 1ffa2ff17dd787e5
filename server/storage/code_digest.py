"""Computes a digest of program code, which becomes part of a cached file's name. A new version of the code then does
not find the file and makes it anew."""

import hashlib
from functools import cache
from pathlib import Path

PIPELINE = Path(__file__).resolve().parents[2] / "pipeline"


@cache
def code_digest(rooms: tuple[str, ...]) -> str:
    """Returns the SHA-256 of all code in the named rooms (paths below ``pipeline``). It is computed once a process."""
    digest = hashlib.sha256()
    for path in sorted(path for room in rooms for path in (PIPELINE / room).glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()
