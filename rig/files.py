"""Writes files so that neither a reader nor a crash leaves or sees a half-written one; computes digests of files and
documents; names this machine's folder for data that can be recomputed (compiled loops, arrays of models, durations)."""

import hashlib
import json
import os
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

CACHE = "EIGENHEAD_CACHE"


def write_atomically(path: Path, data: bytes, *, mode: int = 0o644, parents: bool = True) -> None:
    """Writes ``data`` under a temporary name beside ``path``, syncs it, and renames it. ``mode`` are the file's
    permissions.

    Makes the folder if it is missing. With ``parents`` false it raises FileNotFoundError instead, so that a late write
    does not recreate a removed folder."""
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
    """Yields the temporary files in ``folder`` from writes to ``name``: writes in progress, and writes interrupted by a
    kill or a power failure. ``*`` stands for any text, as in ``Path.glob``."""
    return folder.glob(f".{name}.*.part")


def document_sha256(document: Mapping[str, Any]) -> str:
    """Computes the sha256 of a document's canonical JSON. Results refer to their settings and inputs by it."""
    return hashlib.sha256(json.dumps(document, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def sha256_of(path: Path) -> str:
    """Computes the SHA-256 of a file's content."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def cache_folder() -> Path:
    """Returns EIGENHEAD_CACHE, else $XDG_CACHE_HOME/eigenhead, else ~/.cache/eigenhead. The folder may not exist
    yet."""
    configured = os.environ.get(CACHE)
    if configured:
        return Path(configured)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "eigenhead"
