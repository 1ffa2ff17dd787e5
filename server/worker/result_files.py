"""What a finished job's files are: sizes and hashes, and the warnings in its report."""

import json
from contextlib import suppress
from pathlib import Path

from rig.atomic_write import write_atomically
from rig.messages.message import Message, MessageDocument
from server.storage.objects import sha256_of
from server.storage.records import FileEntry


def warnings_of(report: Path) -> list[MessageDocument]:
    """Returns the warnings in a report.json; none if it is missing or holds none."""
    try:
        return json.loads(report.read_bytes())["warnings"]
    except (OSError, ValueError, KeyError, TypeError):  # no result, or another kind of work
        return []


def add_warning(report: Path, warning: Message) -> None:
    """Adds a warning to a report.json; does nothing where another kind of work wrote none."""
    with suppress(FileNotFoundError):
        document = json.loads(report.read_bytes())
        document["warnings"] = [*document["warnings"], warning.document()]
        write_atomically(report, json.dumps(document, indent=1, ensure_ascii=False).encode())


def described(folder: Path) -> dict[str, FileEntry]:
    """Returns size and SHA-256 of every file below ``folder``, by its relative name."""
    files: dict[str, FileEntry] = {}
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        files[path.relative_to(folder).as_posix()] = {"bytes": path.stat().st_size, "sha256": sha256_of(path)}
    return files
