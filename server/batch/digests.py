"""Computes the SHA-256 of a capture, so that a later run can tell whether its result is up to date."""

import hashlib
import os
from collections.abc import Iterator, Mapping
from pathlib import Path

from rig.formats.pictures.picture_names import is_junk


def capture_sha256(path: Path) -> str:
    """Computes the SHA-256 of a capture: of an archive's bytes, or of the names and bytes of all files in a folder.
    Raises OSError."""
    if not path.is_dir():
        return _file_sha256(path)
    return files_sha256({name: _file_sha256(file) for name, file in _files(path, "", frozenset())})


def files_sha256(files: Mapping[str, str]) -> str:
    """Computes one SHA-256 of a whole folder from the SHA-256 of each of its files, by name."""
    digest = hashlib.sha256()
    for name, file_digest in sorted(files.items()):
        digest.update(f"{name}\0{file_digest}\n".encode("utf-8", "surrogateescape"))
    return digest.hexdigest()


def _files(folder: Path, prefix: str, within: frozenset[tuple[int, int]]) -> Iterator[tuple[str, Path]]:
    """Yields the files below a capture with their paths, following links. ``within`` are the enclosing folders, to stop
    at circular links."""
    state = folder.stat()
    if (here := (state.st_dev, state.st_ino)) in within:
        return
    for entry in os.scandir(folder):
        if is_junk(entry.name):
            continue
        if entry.is_dir():
            yield from _files(Path(entry.path), f"{prefix}{entry.name}/", within | {here})
        elif entry.is_file():
            yield f"{prefix}{entry.name}", Path(entry.path)


def _file_sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
