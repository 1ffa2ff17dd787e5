"""Writing files so that a reader, or a crash, never meets half of one."""

import os
import tempfile
from collections.abc import Iterator
from pathlib import Path


def write_atomically(path: Path, data: bytes, *, mode: int = 0o644, parents: bool = True) -> None:
    """Writes ``data`` under a temporary name beside ``path``, syncs it, and renames it; ``mode`` is the file's.

    Makes the folder if need be; without ``parents`` it must be there, so that what was removed is not made again by a
    write that comes late. Raises FileNotFoundError then.
    """
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
    """Returns temporary files in ``folder`` of a write to ``name`` that goes on, or that a kill or the power cut short;
    ``*`` stands for any text, as in ``Path.glob``."""
    return folder.glob(f".{name}.*.part")
