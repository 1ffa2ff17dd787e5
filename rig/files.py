"""Writes files atomically, computes digests of files and documents, and names the cache folder. The cache folder holds
data that can be recomputed, such as machine code and arrays of head models."""

import hashlib
import json
import os
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

CACHE = "EIGENHEAD_CACHE"


def write_atomically(path: Path, data: bytes, *, mode: int = 0o644, parents: bool = True) -> None:
    """Writes ``data`` to a temporary file beside ``path``, syncs it to disk, and renames it to ``path``. ``mode`` holds
    the file's permissions.

    Creates missing folders. If ``parents`` is False, raises FileNotFoundError for a missing folder instead, so that a
    late write does not recreate a removed folder."""
    if parents:
        path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        Path(name).chmod(mode)
        Path(name).replace(path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def unfinished(folder: Path, name: str = "*") -> Iterator[Path]:
    """Yields the temporary files in ``folder`` from writes to ``name`` that are in progress or were interrupted, for
    example by a power failure. In ``name``, ``*`` matches any text, as in ``Path.glob``."""
    return folder.glob(f".{name}.*.part")


def document_sha256(document: Mapping[str, Any]) -> str:
    """Computes the SHA-256 of a document's canonical JSON. Results store such digests of their settings."""
    return hashlib.sha256(json.dumps(document, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def sha256_of(path: Path) -> str:
    """Computes the SHA-256 of a file's content."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def cache_folder() -> Path:
    """Returns the folder named by EIGENHEAD_CACHE, else $XDG_CACHE_HOME/eigenhead, else ~/.cache/eigenhead."""
    configured = os.environ.get(CACHE)
    if configured:
        return Path(configured)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "eigenhead"
