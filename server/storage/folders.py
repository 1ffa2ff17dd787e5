"""Moves folders durably, and measures them."""

import os
from contextlib import suppress
from pathlib import Path

LAST_SWEEP, STOPPED = "last-sweep.json", "retention-stopped.txt"  # in the data folder: see server.services.retention


def move_durably(folder: Path, target: Path) -> None:
    """Renames a folder whose files have reached the disk, and makes the rename itself durable. Raises OSError if
    ``target`` is a folder with content."""
    for path in [folder, *(path for path in folder.rglob("*") if path.is_dir())]:
        sync_folder(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    folder.rename(target)
    sync_folder(target.parent)


def folder_bytes(folder: Path) -> int:
    """Returns the size in bytes of all files below a folder, except those removed meanwhile; links are not followed."""
    total = 0
    for path, _, names in os.walk(folder):
        for name in names:
            with suppress(FileNotFoundError):
                total += Path(path, name).lstat().st_size
    return total


def newest(path: Path) -> float:
    """Returns when a path, or anything below it, was last modified (s since 1970). Raises FileNotFoundError."""
    times = [path.stat().st_mtime]
    if path.is_dir():
        times += [entry.stat().st_mtime for entry in path.rglob("*")]
    return max(times)


def sync_folder(folder: Path) -> None:
    """Flushes the names in a folder to the disk."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
