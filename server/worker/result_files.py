"""What a finished job's files are: sizes and hashes, and the warnings in its report."""

import hashlib
import json
from pathlib import Path

from rig.messages.message import MessageDocument
from server.storage.records import FileEntry


def warnings_of(report: Path) -> list[MessageDocument]:
    """Returns the warnings in a report.json; none if it is missing or holds none."""
    try:
        return json.loads(report.read_bytes())["warnings"]
    except (OSError, ValueError, KeyError, TypeError):  # no result, or another kind of work
        return []


def described(folder: Path) -> dict[str, FileEntry]:
    """Returns size and SHA-256 of every file below ``folder``, by its relative name."""
    files: dict[str, FileEntry] = {}
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        with path.open("rb") as stream:
            digest = hashlib.file_digest(stream, "sha256").hexdigest()
        files[path.relative_to(folder).as_posix()] = {"bytes": path.stat().st_size, "sha256": digest}
    return files
