"""Manages the folder that a batch fills: results by name, each complete or absent, and records of work in progress.

NAME/             a result as ``eigenhead reconstruct`` writes it, and batch.json: what it was made from
heads.csv heads.parquet sheet.html sheet.pdf
.batch/           claims/, attempts/ (results being made), failures/: gone when nothing is at work and none failed
"""

import hashlib
import json
import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rig.atomic_write import write_atomically
from rig.errors import EigenheadError
from rig.messages.message import Message, compose, documents_of, read_message
from server.storage.result_folder import RESULT_FILE

RECORD = "batch.json"
RECORD_FORMAT, FAILURE_FORMAT = "eigenhead-batch-result/1", "eigenhead-batch-failure/1"
REPORT = "report.json"
FOUND_FILES = ("cameras.json", "calibration.json", "calibration.html", "masks")  # kept for captures without cameras


class ForeignFiles(EigenheadError):
    """Reports that the folder of a result holds files that are no part of a result, so that it must not be replaced."""

    def __init__(self, folder: Path, names: list[str]) -> None:
        super().__init__(compose("batch-foreign-files", folder=str(folder), names=names[:5]))


@dataclass(frozen=True, slots=True)
class Origin:
    """Holds what a result was made from, as SHA-256 of the capture's files, the settings and the model, and the
    program's version. A result is not made again for another ``version`` alone."""

    input_sha256: str
    settings_sha256: str
    model_sha256: str
    version: str

    def is_of(self, other: "Origin") -> bool:
        """Returns whether two results were made from the same input, settings and model, whatever the version."""
        return (self.input_sha256, self.settings_sha256, self.model_sha256) == (
            other.input_sha256,
            other.settings_sha256,
            other.model_sha256,
        )


@dataclass(frozen=True, slots=True)
class FailureRecord:
    """Holds why the latest attempt at a capture failed. ``attempt``: token of the process that made it
    (``Claims.token``)."""

    attempt: str
    kind: str
    message: Message
    faults: tuple[Message, ...]
    origin: Origin | None
    trace: str = ""  # stack trace of a bug in this program


class BatchFolder:
    """Manages the paths and records of the folder ``out`` that a batch fills. Claims (server.batch.claims) decide which
    process may write what."""

    def __init__(self, out: Path) -> None:
        self.out = out
        self.work = out / ".batch"
        self.claims, self.attempts = self.work / "claims", self.work / "attempts"

    def result(self, name: str) -> Path:
        """Returns the folder of a capture's result."""
        return self.out / name

    def origin(self, name: str) -> Origin | None:
        """Reads what a result was made from. Returns None if there is no complete result."""
        folder = self.result(name)
        with suppress(OSError, ValueError, KeyError, TypeError, AttributeError):
            record = json.loads((folder / RECORD).read_text(encoding="utf-8"))
            files: Mapping[str, int] = record["files"]
            whole = record["format"] == RECORD_FORMAT and (folder / REPORT).is_file()
            if whole and all((folder / file).stat().st_size == size for file, size in files.items()):
                return Origin(**{key: record[key] for key in Origin.__dataclass_fields__})
        return None

    def report(self, name: str) -> dict[str, Any]:
        """Reads the report.json of a result. Raises OSError and ValueError."""
        return json.loads((self.result(name) / REPORT).read_text(encoding="utf-8"))

    def new_attempt(self, token: str) -> Path:
        """Makes a folder for one attempt at a result, with the empty folders ``result`` and ``scratch`` in it.
        ``token`` names the process that makes the attempt (``Claims.token``)."""
        number = 0
        while True:
            attempt = self.attempts / f"{token}.{number}"
            try:
                attempt.mkdir(parents=True)  # a process that ends may remove the empty parent folder meanwhile
            except FileExistsError:
                number += 1
                continue
            for part in ("result", "scratch"):
                (attempt / part).mkdir()
            return attempt

    def publish(self, name: str, attempt: Path, origin: Origin) -> None:
        """Renames the finished result of an attempt to its final place, replacing an earlier result of that name, and
        removes the failure record.

        Raises ForeignFiles, and OSError if another process has just published the same result.
        """
        made, target = attempt / "result", self.result(name)
        self.check_replaceable(name)
        sizes = {path.relative_to(made).as_posix(): path.stat().st_size for path in _files(made)}
        sizes.pop(REPORT, None)  # it contains durations, so its size varies
        document = {"format": RECORD_FORMAT, "capture": name, **asdict(origin), "files": dict(sorted(sizes.items()))}
        write_atomically(made / RECORD, json.dumps(document, indent=1).encode())
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.exists():
            target.rename(attempt / "replaced")
        made.rename(target)  # fails if a folder with files exists there
        self.failure_file(name).unlink(missing_ok=True)

    def check_replaceable(self, name: str) -> None:
        """Raises ForeignFiles if the folder of a result holds files that are no part of a result."""
        try:
            entries = sorted(path.name for path in self.result(name).iterdir())
        except FileNotFoundError:
            return
        if foreign := [entry for entry in entries if entry not in FOUND_FILES and not RESULT_FILE.match(entry)]:
            raise ForeignFiles(self.result(name), foreign)

    def remove_attempts(self, is_alive: Callable[[str], bool]) -> None:
        """Removes the attempts of processes that have ended. ``is_alive`` is asked for each process by its token."""
        for path in self._attempts():
            if not is_alive(path.name.partition(".")[0]):
                shutil.rmtree(path, ignore_errors=True)

    def failure(self, name: str) -> FailureRecord | None:
        """Reads why the latest attempt at a capture failed. Returns None if there is no such record."""
        with suppress(OSError, ValueError, KeyError, TypeError):
            record = json.loads(self.failure_file(name).read_text(encoding="utf-8"))
            origin = None if record["origin"] is None else Origin(**record["origin"])
            message, faults = read_message(record["message"]), tuple(map(read_message, record["faults"]))
            return FailureRecord(record["attempt"], record["kind"], message, faults, origin, record["trace"])
        return None

    def note_failure(self, name: str, failure: FailureRecord) -> None:
        """Writes why the latest attempt at a capture failed, replacing an earlier record atomically. Raises OSError."""
        document = {
            "format": FAILURE_FORMAT,
            "capture": name,
            "attempt": failure.attempt,
            "kind": failure.kind,
            "message": failure.message.document(),
            "faults": documents_of(failure.faults),
            "origin": None if failure.origin is None else asdict(failure.origin),
            "trace": failure.trace,
        }
        write_atomically(self.failure_file(name), json.dumps(document, indent=1).encode())

    def failure_file(self, name: str) -> Path:
        """Returns the path of a capture's failure record."""
        return self.work / "failures" / f"{file_name(name)}.json"

    def forget_failures_but_of(self, names: set[str]) -> None:
        """Removes the failure records of all captures that are not in ``names``, and files that a kill left half
        written."""
        retained = {self.failure_file(name).name for name in names}
        with suppress(FileNotFoundError):
            for path in (self.work / "failures").iterdir():
                if path.name not in retained:
                    path.unlink(missing_ok=True)

    def remove_empty_folders(self) -> None:
        """Removes the empty folders in ``.batch``, unless other processes are at work there."""
        with suppress(OSError):
            for folder in (self.claims / "owners", self.claims):
                folder.rmdir()
        if self.claims.exists():
            return
        for folder in (self.attempts, self.work / "failures", self.work):
            with suppress(OSError):
                folder.rmdir()

    def _attempts(self) -> list[Path]:
        try:
            return list(self.attempts.iterdir())
        except FileNotFoundError:
            return []


def file_name(name: str) -> str:
    """Returns a readable file name for the name of a capture. Different names give different file names."""
    readable = re.sub(r"[^\w-]+", "-", name)[:60]
    return f"{readable}.{hashlib.sha256(name.encode('utf-8', 'surrogateescape')).hexdigest()[:16]}"


def _files(folder: Path) -> Iterator[Path]:
    return (path for path in sorted(folder.rglob("*")) if path.is_file())
