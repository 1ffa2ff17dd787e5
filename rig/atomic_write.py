"""Writes files so that neither a reader nor a crash leaves or sees a half-written one."""

import os
import tempfile
from collections.abc import Iterator
from pathlib import Path


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
